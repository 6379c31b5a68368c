//! Writes episodes as one data set in the layout of LeRobot v3.0 (info.json, stats.json, Parquet tables, MP4 videos).
//!
//! What a policy sees is `observation.state` (measured alpha and V_e; NaN where unknown) and `observation.images.camera`. What was done is
//! `action`, the commanded alpha. LeRobot's clock is exact, `frame_index / fps`, so a lost frame becomes a row with the image of the frame
//! before it. Each episode has its own video. The weight is an extra column of the episodes' table. It runs on the command's thread and
//! allocates: it holds the rows of all episodes, but only one image at a time. Nothing that exists is overwritten.

use std::fs;
use std::path::{Path, PathBuf};

use indicatif::ProgressBar;
use parquet::file::metadata::KeyValue;
use serde_json::{Value, json};
use shared::episode::{Episode, EpisodeKind};

use super::output::{ExportError, make_parent, write_error};
use super::video::{USUAL_RATE_HZ, Video, for_each_row_with_image, mean_rate_hz};

mod parquet_table;
mod statistics;

use parquet_table::{Column, write_parquet};
use statistics::{ImageStatistics, Moments};

/// Name of the images' column. LeRobot wants the prefix `observation.images`.
const CAMERA: &str = "observation.images.camera";
/// Files in one directory, which LeRobot calls `chunks_size`; this is LeRobot's own default.
const FILES_A_CHUNK: usize = 1000;
/// Of this many images, one enters the images' statistics. Chosen by hand: neighbouring images are nearly the same.
const IMAGE_STEP: usize = 10;

/// Writes the data set of `episodes`, which were read from `files`, into the new directory `root`. Each image moves `bar` on by one.
pub fn write(files: &[PathBuf], episodes: &[Episode], root: &Path, bar: &ProgressBar) -> Result<(), ExportError> {
    if root.join("meta").exists() {
        return Err(write_error(root, "holds a data set already; name another directory"));
    }
    let fps = episodes.first().map_or(USUAL_RATE_HZ, mean_rate_hz).round();
    let mut tasks: Vec<String> = Vec::new();
    let mut rows = DataTable::default();
    let mut list = EpisodeTable::default();
    let mut images = ImageStatistics::new();
    for (number, (file, episode)) in files.iter().zip(episodes).enumerate() {
        let task = match episode.kind {
            EpisodeKind::Pour { goal_ml } => format!("pour {goal_ml} ml"),
            EpisodeKind::Recording(_) | EpisodeKind::Table => "tilt along a curve and back".into(),
        };
        let task_index = tasks.iter().position(|t| *t == task).unwrap_or_else(|| {
            tasks.push(task.clone());
            tasks.len() - 1
        });
        let (chunk, index) = (number / FILES_A_CHUNK, number % FILES_A_CHUNK);
        let path = root.join(format!("videos/{CAMERA}/chunk-{chunk:03}/file-{index:03}.mp4"));
        make_parent(&path)?;
        let mut video = Video::new(&path, fps);
        let mut shown = 0;
        for_each_row_with_image(file, episode, |image| {
            if shown % IMAGE_STEP == 0 {
                images.add(image).map_err(|e| write_error(&path, e.message))?;
            }
            shown += 1;
            bar.inc(1);
            video.push(image)
        })?;
        video.finish()?;
        let from = rows.index.len();
        rows.add(episode, number, task_index, fps);
        list.add(episode, task, (from, rows.index.len()), (chunk, index), fps);
    }

    let stats = rows.stats(&images);
    let info = info(episodes.len(), rows.index.len(), tasks.len(), fps, &images);
    write_parquet(&root.join("data/chunk-000/file-000.parquet"), rows.columns(), None)?;
    write_parquet(&root.join("meta/episodes/chunk-000/file-000.parquet"), list.columns(), None)?;
    write_tasks(&root.join("meta/tasks.parquet"), tasks)?;
    write_json(&root.join("meta/stats.json"), &stats)?;
    write_json(&root.join("meta/info.json"), &info)
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

/// The description of the data set, `meta/info.json`.
fn info(episodes: usize, frames: usize, tasks: usize, fps: f64, images: &ImageStatistics) -> Value {
    let one = |kind: &str| json!({ "dtype": kind, "shape": [1], "names": null });
    json!({
        "codebase_version": "v3.0",
        "robot_type": "ur5",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": FILES_A_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps as i64,
        "splits": { "train": format!("0:{episodes}") },
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {
            "observation.state": { "dtype": "float32", "shape": [2], "names": ["alpha_measured_deg", "area_px2"] },
            "action": { "dtype": "float32", "shape": [1], "names": ["alpha_commanded_deg"] },
            CAMERA: {
                "dtype": "video",
                "shape": [images.height_px, images.width_px, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": images.height_px, "video.width": images.width_px, "video.codec": "h264",
                    "video.pix_fmt": "yuv420p", "video.is_depth_map": false, "video.fps": fps as i64, "video.channels": 3,
                    "has_audio": false,
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

/// The table `data`: one row for each row of each episode.
#[derive(Default)]
struct DataTable {
    state: Vec<f32>,
    action: Vec<f32>,
    timestamp: Vec<f32>,
    frame_index: Vec<i64>,
    episode_index: Vec<i64>,
    index: Vec<i64>,
    task_index: Vec<i64>,
}

impl DataTable {
    fn add(&mut self, episode: &Episode, number: usize, task: usize, fps: f64) {
        for (n, row) in episode.rows.iter().enumerate() {
            self.state.extend([row.alpha_measured_deg, row.area_px2]);
            self.action.push(row.alpha_commanded_deg);
            self.timestamp.push((n as f64 / fps) as f32);
            self.frame_index.push(n as i64);
            self.episode_index.push(number as i64);
            self.index.push(self.index.len() as i64);
            self.task_index.push(task as i64);
        }
    }

    fn stats(&self, images: &ImageStatistics) -> Value {
        let of = |values: &mut dyn Iterator<Item = f64>| Moments::of(values);
        let ints = |values: &[i64]| of(&mut values.iter().map(|v| *v as f64)).json();
        let lane = |lane: usize| of(&mut self.state.iter().skip(lane).step_by(2).map(|v| f64::from(*v)));
        json!({
            "observation.state": Moments::columns(&[lane(0), lane(1)]),
            "action": of(&mut self.action.iter().map(|v| f64::from(*v))).json(),
            "timestamp": of(&mut self.timestamp.iter().map(|v| f64::from(*v))).json(),
            "frame_index": ints(&self.frame_index),
            "episode_index": ints(&self.episode_index),
            "index": ints(&self.index),
            "task_index": ints(&self.task_index),
            CAMERA: images.json(),
        })
    }

    fn columns(self) -> Vec<(String, Column)> {
        vec![
            ("observation.state".into(), Column::FloatList { width: 2, values: self.state }),
            ("action".into(), Column::Float(self.action)),
            ("timestamp".into(), Column::Float(self.timestamp)),
            ("frame_index".into(), Column::Int(self.frame_index)),
            ("episode_index".into(), Column::Int(self.episode_index)),
            ("index".into(), Column::Int(self.index)),
            ("task_index".into(), Column::Int(self.task_index)),
        ]
    }
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
    weight_g: Vec<f64>,
}

impl EpisodeTable {
    fn add(&mut self, episode: &Episode, task: String, rows: (usize, usize), video: (usize, usize), fps: f64) {
        self.tasks.push(task);
        self.length.push((rows.1 - rows.0) as i64);
        self.from.push(rows.0 as i64);
        self.to.push(rows.1 as i64);
        self.video_chunk.push(video.0 as i64);
        self.video_file.push(video.1 as i64);
        self.seconds.push((rows.1 - rows.0) as f64 / fps);
        self.weight_g.push(episode.weight_g.unwrap_or(f64::NAN));
    }

    fn columns(self) -> Vec<(String, Column)> {
        let n = self.length.len();
        let zeros = || Column::Int(vec![0; n]);
        vec![
            ("episode_index".into(), Column::Int((0..n as i64).collect())),
            ("tasks".into(), Column::TextList(self.tasks)),
            ("length".into(), Column::Int(self.length)),
            ("weight_g".into(), Column::Double(self.weight_g)),
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
        ]
    }
}

fn write_json(path: &Path, value: &Value) -> Result<(), ExportError> {
    make_parent(path)?;
    fs::write(path, format!("{value:#}\n")).map_err(|e| write_error(path, e))
}
