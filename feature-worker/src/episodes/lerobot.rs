//! Writes episodes as one data set in the layout of LeRobot v3.0 (info.json, stats.json, Parquet tables, MP4 videos).
//!
//! What a policy sees is `observation.state` (measured alpha and V_e) and `observation.images.camera`. What was done is `action`, the commanded
//! alpha and its rate. `known` says of each row whether its image is its own, and whether alpha and V_e were measured; where not, they are filled
//! with the value before. No number is NaN. LeRobot's clock is exact, `frame_index / fps`, so a frame that was lost becomes a row with the image of
//! the frame before it, as does one whose image was dropped. Each episode has its own video, and its own statistics, from which LeRobot makes those of parts. The weight is an extra
//! column of the episodes' table, null where there is none. It runs on the command's thread and allocates: it holds the rows of all episodes,
//! but only one image at a time. Nothing that exists is overwritten. `scripts/check-lerobot` trains and edits with LeRobot itself.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use indicatif::ProgressBar;
use parquet::file::metadata::KeyValue;
use serde_json::{Value, json};
use shared::episode::{Episode, EpisodeKind, EpisodeRow};
use shared::whole_file;

use super::output::{ExportError, LeftOut, disk_error, make_parent, unfit, write_error};
use super::video::{USUAL_RATE_HZ, Video, for_each_row_with_image, mean_rate_hz};

mod parquet_table;
mod statistics;

use parquet_table::{Column, write_parquet};
use statistics::{ImageLevels, NUMBERS, Summary};

/// Name of the images' column. LeRobot wants the prefix `observation.images`.
const CAMERA: &str = "observation.images.camera";
/// Files in one directory, which LeRobot calls `chunks_size`; this is LeRobot's own default.
const FILES_A_CHUNK: usize = 1000;
/// Of this many images, one enters the images' statistics. Chosen by hand: neighbouring images are nearly the same.
const IMAGE_STEP: usize = 10;

/// The part by which an episode's rate may differ from the data set's, and the data set's from a whole number. Chosen by hand: the rates of one camera scatter less, and the usual rates
/// (24, 25, 30, 60) differ by more.
const RATE_TOLERANCE: f64 = 0.03;

/// Writes the data set of `episodes`, each with the file that it was read from, into the new directory `root`. Each image moves `bar` on by
/// one. The data set has the middle one of the episodes' rates. Adds to `left_out` what is not in it: files without images, with images that cannot be
/// read, of another size than those before, or at another rate. If that is all of them, there is no data set, and it returns false. On failure nothing
/// of it stays.
pub fn write(episodes: &[(PathBuf, Episode)], root: &Path, bar: &ProgressBar, left_out: &mut Vec<LeftOut>) -> Result<bool, ExportError> {
    // Whoever makes all three has the data set. Of two exports at once the other one takes nothing away.
    let mut ours = Vec::new();
    for part in ["data", "meta", "videos"].map(|part| root.join(part)) {
        match fs::create_dir(&part) {
            Ok(()) => ours.push(part),
            Err(e) => {
                ours.iter().for_each(|part| drop(fs::remove_dir(part)));
                let held = e.kind() == std::io::ErrorKind::AlreadyExists;
                let refused = || write_error(root, "holds a data set already, or a part of one; name another directory");
                return Err(if held { refused() } else { disk_error(&part, &e) });
            }
        }
    }
    let written = write_set(episodes, root, bar, left_out);
    if !matches!(written, Ok(true)) {
        ours.iter().for_each(|part| drop(fs::remove_dir_all(part)));
    }
    written
}

fn write_set(episodes: &[(PathBuf, Episode)], root: &Path, bar: &ProgressBar, left_out: &mut Vec<LeftOut>) -> Result<bool, ExportError> {
    let mut rates_hz: Vec<f64> = episodes.iter().map(|(_, e)| mean_rate_hz(e)).collect();
    rates_hz.sort_by(f64::total_cmp);
    let mut set = DataSet::new(rates_hz.get(rates_hz.len() / 2).copied().unwrap_or(USUAL_RATE_HZ));
    for (file, episode) in episodes {
        match set.add(file, episode, root, bar) {
            Ok(()) => {}
            Err(e) if e.spares_others() => left_out.push(LeftOut { file: file.clone(), why: e.to_string() }),
            Err(e) => return Err(e),
        }
    }
    if set.list.length.is_empty() {
        return Ok(false);
    }
    set.finish(root).map(|()| true)
}

/// The data set under way.
struct DataSet {
    /// The rate by the episodes' clocks, frames a second.
    rate_hz: f64,
    /// It as a whole number, as LeRobot wants it.
    fps: f64,
    tasks: Vec<String>,
    rows: DataTable,
    list: EpisodeTable,
    images: ImageLevels,
    /// Width and height of the images, px, and the name of the videos' codec.
    video: Option<(i32, i32, &'static str)>,
}

impl DataSet {
    fn new(rate_hz: f64) -> Self {
        let (rows, list) = (DataTable::default(), EpisodeTable::default());
        Self { rate_hz, fps: rate_hz.round(), tasks: Vec::new(), rows, list, images: ImageLevels::new(), video: None }
    }

    /// Writes the video of an episode and takes its rows. On failure the data set is as it was before.
    fn add(&mut self, file: &Path, episode: &Episode, root: &Path, bar: &ProgressBar) -> Result<(), ExportError> {
        let own_hz = mean_rate_hz(episode);
        if (own_hz / self.rate_hz - 1.0).abs() > RATE_TOLERANCE {
            // LeRobot's clock is the row's number, so that rows of another rate would be shown too fast or too slow.
            let set_hz = self.rate_hz;
            return Err(unfit(
                file,
                format!("it has {own_hz:.1} frames a second, and the data set {set_hz:.1}; export it into another one"),
            ));
        }
        if (self.fps / self.rate_hz - 1.0).abs() > RATE_TOLERANCE {
            // LeRobot's rate is a whole number, and with another one all its times and rates would be wrong.
            let (set_hz, fps) = (self.rate_hz, self.fps);
            return Err(unfit(
                file,
                format!("the data set has {set_hz:.1} frames a second, which LeRobot would show as {fps}; record at a whole number"),
            ));
        }
        let number = self.list.length.len();
        let task = match episode.kind {
            EpisodeKind::Pour { goal_ml } => format!("pour {goal_ml} ml"),
            EpisodeKind::Recording(_) | EpisodeKind::Table => "tilt along a curve and back".into(),
        };
        let (chunk, index) = (number / FILES_A_CHUNK, number % FILES_A_CHUNK);
        let path = root.join(format!("videos/{CAMERA}/chunk-{chunk:03}/file-{index:03}.mp4"));
        make_parent(&path)?;
        let levels = match self.write_video(file, episode, &path, bar) {
            Ok(levels) => levels,
            Err(e) => {
                // The file is ours: the directory was new. A directory with another video in it stays.
                let _ = fs::remove_file(&path);
                path.ancestors().skip(1).take_while(|directory| *directory != root).for_each(|empty| drop(fs::remove_dir(empty)));
                return Err(e);
            }
        };
        let task_index = self.tasks.iter().position(|t| *t == task).unwrap_or_else(|| {
            self.tasks.push(task.clone());
            self.tasks.len() - 1
        });
        self.images.join(&levels);
        let from = self.rows.index.len();
        self.rows.add(episode, number, task_index, self.fps);
        let mut summaries = self.rows.summaries(from);
        summaries.push((CAMERA, levels.summaries()));
        self.list.add(episode, task, (from, self.rows.index.len()), (chunk, index), self.fps, &summaries);
        Ok(())
    }

    fn write_video(&mut self, file: &Path, episode: &Episode, path: &Path, bar: &ProgressBar) -> Result<ImageLevels, ExportError> {
        let mut video = Video::new(file, path, self.fps);
        let mut levels = ImageLevels::new();
        let mut shown = 0;
        let known = self.video.map(|(width, height, _)| (width, height));
        for_each_row_with_image(file, episode, |image| {
            bar.inc(1);
            let picture = video.push(image)?;
            if shown % IMAGE_STEP == 0 {
                levels.add(&picture).map_err(|e| unfit(file, e.message))?;
            }
            shown += 1;
            match (known, video.size()) {
                (Some(first), Some(size)) if first != size => {
                    Err(unfit(file, format!("its images are {} x {} px, those before {} x {} px", size.0, size.1, first.0, first.1)))
                }
                _ => Ok(()),
            }
        })?;
        if let Some((width, height)) = video.size() {
            self.video = Some((width, height, video.codec()));
        }
        video.finish()?;
        Ok(levels)
    }

    /// Writes all tables.
    fn finish(self, root: &Path) -> Result<(), ExportError> {
        let mut stats = serde_json::Map::new();
        for (name, summaries) in self.rows.summaries(0) {
            stats.insert(name.into(), Summary::json(&summaries));
        }
        stats.insert(CAMERA.into(), Summary::image_json(&self.images.summaries()));
        let info = self.info();
        write_parquet(&root.join("data/chunk-000/file-000.parquet"), self.rows.columns(), None)?;
        write_parquet(&root.join("meta/episodes/chunk-000/file-000.parquet"), self.list.columns(), None)?;
        write_tasks(&root.join("meta/tasks.parquet"), self.tasks)?;
        write_json(&root.join("meta/stats.json"), &stats.into())?;
        write_json(&root.join("meta/info.json"), &info)
    }

    /// The description of the data set, `meta/info.json`.
    fn info(&self) -> Value {
        let one = |kind: &str| json!({ "dtype": kind, "shape": [1], "names": null });
        let (episodes, fps) = (self.list.length.len(), self.fps as i64);
        let (width_px, height_px, codec) = self.video.unwrap_or((0, 0, ""));
        json!({
            "codebase_version": "v3.0",
            "robot_type": "ur5",
            "total_episodes": episodes,
            "total_frames": self.rows.index.len(),
            "total_tasks": self.tasks.len(),
            "chunks_size": FILES_A_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": fps,
            "splits": { "train": format!("0:{episodes}") },
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            "features": {
                "observation.state": { "dtype": "float32", "shape": [2], "names": ["alpha_measured_deg", "area_px2"] },
                "action": { "dtype": "float32", "shape": [2], "names": ["alpha_commanded_deg", "alpha_commanded_deg_per_s"] },
                "known": { "dtype": "bool", "shape": [3], "names": ["frame", "alpha_measured_deg", "area_px2"] },
                CAMERA: {
                    "dtype": "video",
                    "shape": [height_px, width_px, 3],
                    "names": ["height", "width", "channels"],
                    "info": {
                        "video.height": height_px, "video.width": width_px, "video.codec": codec,
                        "video.pix_fmt": "yuv420p", "video.fps": fps, "video.channels": 3,
                        "has_audio": false, "is_depth_map": false,
                    },
                },
                "timestamp": one("float32"),
                "frame_index": one("int64"),
                "episode_index": one("int64"),
                "index": one("int64"),
                "task_index": one("int64"),
            },
        })
    }
}

/// Writes the table of tasks. LeRobot reads this one with pandas and expects the task as the index.
fn write_tasks(path: &Path, tasks: Vec<String>) -> Result<(), ExportError> {
    let numbers = (0..tasks.len() as i64).collect();
    let pandas = json!({
        "index_columns": ["task"],
        "column_indexes": [{ "name": null, "field_name": null, "pandas_type": "unicode", "numpy_type": "object", "metadata": null }],
        "columns": [
            { "name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": null },
            { "name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": null },
        ],
        "pandas_version": "2.0.0",
    });
    let columns = vec![("task_index".into(), Column::Int(numbers)), ("task".into(), Column::Text(tasks))];
    write_parquet(path, columns, Some(KeyValue::new("pandas".into(), pandas.to_string())))
}

/// The table `data`: one row for each row of each episode.
#[derive(Default)]
struct DataTable {
    /// Two in a row.
    state: Vec<f32>,
    /// Two in a row.
    action: Vec<f32>,
    /// Three in a row.
    known: Vec<bool>,
    timestamp: Vec<f32>,
    frame_index: Vec<i64>,
    episode_index: Vec<i64>,
    index: Vec<i64>,
    task_index: Vec<i64>,
}

impl DataTable {
    /// Takes the rows of an episode. What is not known is the value before, as a policy at work would have it: of V_e 0 before the first, of
    /// alpha the commanded one.
    fn add(&mut self, episode: &Episode, number: usize, task: usize, fps: f64) {
        let (mut alpha_deg, mut area_px2) = (None, 0.0);
        for (n, row) in episode.rows.iter().enumerate() {
            let (alpha_known, area_known) = (row.alpha_measured_deg.is_finite(), row.area_px2.is_finite());
            if alpha_known {
                alpha_deg = Some(row.alpha_measured_deg);
            }
            if area_known {
                area_px2 = row.area_px2;
            }
            self.state.extend([alpha_deg.unwrap_or(row.alpha_commanded_deg), area_px2]);
            self.known.extend([row.image, alpha_known, area_known]);
            self.action.extend([row.alpha_commanded_deg, rate_deg_per_s(&episode.rows, n)]);
            self.timestamp.push((n as f64 / fps) as f32);
            self.frame_index.push(n as i64);
            self.episode_index.push(number as i64);
            self.index.push(self.index.len() as i64);
            self.task_index.push(task as i64);
        }
    }

    /// The statistics of each column over the rows from row `from` on.
    fn summaries(&self, from: usize) -> Vec<(&'static str, Vec<Summary>)> {
        let ints = |values: &[i64]| vec![Summary::of(values[from..].iter().map(|v| *v as f64))];
        let floats = |values: &[f32], width: usize| {
            let lane = |lane| Summary::of(values[from * width..].iter().skip(lane).step_by(width).map(|v| f64::from(*v)));
            (0..width).map(lane).collect::<Vec<_>>()
        };
        let known: Vec<f32> = self.known.iter().map(|k| f32::from(u8::from(*k))).collect();
        vec![
            ("observation.state", floats(&self.state, 2)),
            ("action", floats(&self.action, 2)),
            ("known", floats(&known, 3)),
            ("timestamp", floats(&self.timestamp, 1)),
            ("frame_index", ints(&self.frame_index)),
            ("episode_index", ints(&self.episode_index)),
            ("index", ints(&self.index)),
            ("task_index", ints(&self.task_index)),
        ]
    }

    fn columns(self) -> Vec<(String, Column)> {
        vec![
            ("observation.state".into(), Column::FloatList { width: 2, values: self.state }),
            ("action".into(), Column::FloatList { width: 2, values: self.action }),
            ("known".into(), Column::BoolList { width: 3, values: self.known }),
            ("timestamp".into(), Column::Float(self.timestamp)),
            ("frame_index".into(), Column::Int(self.frame_index)),
            ("episode_index".into(), Column::Int(self.episode_index)),
            ("index".into(), Column::Int(self.index)),
            ("task_index".into(), Column::Int(self.task_index)),
        ]
    }
}

/// Rate of the commanded alpha from row `n` to the next, degrees a second; at the last row, from the one before; 0 for a single row.
fn rate_deg_per_s(rows: &[EpisodeRow], n: usize) -> f32 {
    let from = if n + 1 < rows.len() { n } else { n.saturating_sub(1) };
    let (Some(a), Some(b)) = (rows.get(from), rows.get(from + 1)) else { return 0.0 };
    let rate = f64::from(b.alpha_commanded_deg - a.alpha_commanded_deg) / (b.t_s - a.t_s);
    if rate.is_finite() { rate as f32 } else { 0.0 }
}

/// The table `meta/episodes`: one row for each episode.
#[derive(Default)]
struct EpisodeTable {
    tasks: Vec<String>,
    length: Vec<i64>,
    from: Vec<i64>,
    to: Vec<i64>,
    video_chunk: Vec<i64>,
    video_file: Vec<i64>,
    seconds: Vec<f64>,
    weight_g: Vec<Option<f64>>,
    /// The columns of the statistics, by column and number: values a row, all values.
    stats: BTreeMap<(String, &'static str), (usize, Vec<f64>)>,
    /// How many rows, or images, the statistics of a column are made of.
    counts: BTreeMap<String, Vec<i64>>,
}

impl EpisodeTable {
    fn add(
        &mut self,
        episode: &Episode,
        task: String,
        rows: (usize, usize),
        video: (usize, usize),
        fps: f64,
        summaries: &[(&'static str, Vec<Summary>)],
    ) {
        self.tasks.push(task);
        self.length.push((rows.1 - rows.0) as i64);
        self.from.push(rows.0 as i64);
        self.to.push(rows.1 as i64);
        self.video_chunk.push(video.0 as i64);
        self.video_file.push(video.1 as i64);
        self.seconds.push((rows.1 - rows.0) as f64 / fps);
        self.weight_g.push(episode.weight_g);
        for (column, all) in summaries {
            for (i, number) in NUMBERS.into_iter().enumerate() {
                let (width, values) = self.stats.entry(((*column).into(), number)).or_default();
                *width = all.len();
                values.extend(all.iter().map(|s| s.numbers[i]));
            }
            self.counts.entry((*column).into()).or_default().push(all.first().map_or(0, |s| s.count as i64));
        }
    }

    fn columns(self) -> Vec<(String, Column)> {
        let n = self.length.len();
        let zeros = || Column::Int(vec![0; n]);
        let mut columns = vec![
            ("episode_index".into(), Column::Int((0..n as i64).collect())),
            ("tasks".into(), Column::TextList(self.tasks)),
            ("length".into(), Column::Int(self.length)),
            ("weight_g".into(), Column::OptionalDouble(self.weight_g)),
            ("data/chunk_index".into(), zeros()),
            ("data/file_index".into(), zeros()),
            ("dataset_from_index".into(), Column::Int(self.from)),
            ("dataset_to_index".into(), Column::Int(self.to)),
            (format!("videos/{CAMERA}/chunk_index"), Column::Int(self.video_chunk)),
            (format!("videos/{CAMERA}/file_index"), Column::Int(self.video_file)),
            (format!("videos/{CAMERA}/from_timestamp"), Column::Double(vec![0.0; n])),
            (format!("videos/{CAMERA}/to_timestamp"), Column::Double(self.seconds)),
            ("meta/episodes/chunk_index".into(), zeros()),
            ("meta/episodes/file_index".into(), zeros()),
        ];
        for ((column, number), (width, values)) in self.stats {
            let name = format!("stats/{column}/{number}");
            let list = if column == CAMERA { Column::ChannelList { width, values } } else { Column::DoubleList { width, values } };
            columns.push((name, list));
        }
        for (column, counts) in self.counts {
            columns.push((format!("stats/{column}/count"), Column::IntList(counts)));
        }
        columns
    }
}

fn write_json(path: &Path, value: &Value) -> Result<(), ExportError> {
    make_parent(path)?;
    whole_file::create(path, format!("{value:#}\n").as_bytes()).map_err(|e| write_error(path, e))
}
