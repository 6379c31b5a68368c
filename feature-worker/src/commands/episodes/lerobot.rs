//! Writes episodes as one data set in the layout of LeRobot v3.0 (info.json, stats.json, Parquet tables, MP4 videos).
//!
//! What a policy sees is `observation.state` (measured alpha, V_e; NaN where unknown) and `observation.images.camera`; what
//! was done is `action`, the commanded alpha. LeRobot's clock is exact, `frame_index / fps`: frames that were lost are rows
//! with the image of the frame before. One video an episode. The weight is an extra column of the episodes' table.
//! Allocates; holds the rows of all episodes, never their images.

use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use indicatif::ProgressBar;
use opencv::core::{self, Mat, MatTraitConst, MatTraitConstManual, Vector};
use opencv::imgcodecs;
use parquet::basic::Compression;
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, FloatType, Int64Type};
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::parser::parse_message_type;
use serde_json::{Value, json};
use shared::episode::{Episode, EpisodeImage, EpisodeKind};

use super::export::{ExportError, Video, frames_with_images, rate_hz, write_error};

const CAMERA: &str = "observation.images.camera";
/// LeRobot's `chunks_size`: files a directory.
const FILES_A_CHUNK: usize = 1000;
/// Every so many-th image counts for the images' statistics.
const IMAGE_STEP: usize = 10;

/// One column of a table; all have the same number of rows.
enum Column {
    Int(Vec<i64>),
    Float(Vec<f32>),
    Double(Vec<f64>),
    Text(Vec<String>),
    /// Rows of `width` values each.
    FloatList {
        width: usize,
        values: Vec<f32>,
    },
    /// Rows of one text each.
    TextList(Vec<String>),
}

/// Writes the data set into the new directory `root`.
pub(super) fn write(files: &[PathBuf], episodes: &[Episode], root: &Path, bar: &ProgressBar) -> Result<(), ExportError> {
    if root.join("meta").exists() {
        return Err(write_error(root, "holds a data set already; name another directory"));
    }
    let fps = episodes.first().map_or(30.0, rate_hz).round();
    let mut tasks: Vec<String> = Vec::new();
    let mut rows = Rows::default();
    let mut list = List::default();
    let mut pictures = Pictures::default();
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
        frames_with_images(file, episode, |image| {
            if shown % IMAGE_STEP == 0 {
                pictures.add(image).map_err(|e| write_error(&path, e.message))?;
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

    let stats = rows.stats(&pictures);
    let info = info(episodes.len(), rows.index.len(), tasks.len(), fps, &pictures);
    write_parquet(&root.join("data/chunk-000/file-000.parquet"), rows.columns(), None)?;
    write_parquet(&root.join("meta/episodes/chunk-000/file-000.parquet"), list.columns(), None)?;
    let numbers = (0..tasks.len() as i64).collect();
    // LeRobot reads this one with pandas and expects the task as the index.
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
    write_parquet(&root.join("meta/tasks.parquet"), columns, Some(KeyValue::new("pandas".into(), pandas.to_string())))?;
    write_json(&root.join("meta/stats.json"), &stats)?;
    write_json(&root.join("meta/info.json"), &info)
}

fn info(episodes: usize, frames: usize, tasks: usize, fps: f64, pictures: &Pictures) -> Value {
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
                "shape": [pictures.height, pictures.width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": pictures.height, "video.width": pictures.width, "video.codec": "h264",
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

/// The table `data`: one row a frame.
#[derive(Default)]
struct Rows {
    state: Vec<f32>,
    action: Vec<f32>,
    timestamp: Vec<f32>,
    frame_index: Vec<i64>,
    episode_index: Vec<i64>,
    index: Vec<i64>,
    task_index: Vec<i64>,
}

impl Rows {
    fn add(&mut self, episode: &Episode, number: usize, task: usize, fps: f64) {
        for (n, frame) in episode.rows.iter().enumerate() {
            self.state.extend([frame.alpha_measured_deg, frame.area_px2]);
            self.action.push(frame.alpha_commanded_deg);
            self.timestamp.push((n as f64 / fps) as f32);
            self.frame_index.push(n as i64);
            self.episode_index.push(number as i64);
            self.index.push(self.index.len() as i64);
            self.task_index.push(task as i64);
        }
    }

    fn stats(&self, pictures: &Pictures) -> Value {
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
            CAMERA: pictures.json(),
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

/// The table `meta/episodes`: one row an episode.
#[derive(Default)]
struct List {
    tasks: Vec<String>,
    length: Vec<i64>,
    from: Vec<i64>,
    to: Vec<i64>,
    video_chunk: Vec<i64>,
    video_file: Vec<i64>,
    seconds: Vec<f64>,
    weight_g: Vec<f64>,
}

impl List {
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

/// Statistics of one number over all rows where it is known.
#[derive(Clone, Copy)]
struct Moments {
    min: f64,
    max: f64,
    sum: f64,
    squares: f64,
    count: u64,
}

impl Moments {
    const EMPTY: Self = Self { min: f64::INFINITY, max: f64::NEG_INFINITY, sum: 0.0, squares: 0.0, count: 0 };

    fn of(values: &mut dyn Iterator<Item = f64>) -> Self {
        values.filter(|v| v.is_finite()).fold(Self::EMPTY, |m, v| Self {
            min: m.min.min(v),
            max: m.max.max(v),
            sum: m.sum + v,
            squares: m.squares + v * v,
            count: m.count + 1,
        })
    }

    fn mean(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.sum / self.count as f64 }
    }

    fn std(&self) -> f64 {
        if self.count == 0 { 0.0 } else { (self.squares / self.count as f64 - self.mean().powi(2)).max(0.0).sqrt() }
    }

    fn json(&self) -> Value {
        Self::columns(&[*self])
    }

    fn columns(all: &[Self]) -> Value {
        let each = |f: fn(&Self) -> f64| all.iter().map(|m| if m.count == 0 { 0.0 } else { f(m) }).collect::<Vec<_>>();
        json!({
            "min": each(|m| m.min),
            "max": each(|m| m.max),
            "mean": each(Self::mean),
            "std": each(Self::std),
            "count": [all.iter().map(|m| m.count).max().unwrap_or(0)],
        })
    }
}

/// Size and colour statistics of the images, red, green and blue from 0 to 1.
struct Pictures {
    width: i32,
    height: i32,
    channels: [Moments; 3],
}

impl Default for Pictures {
    fn default() -> Self {
        Self { width: 0, height: 0, channels: [Moments::EMPTY; 3] }
    }
}

impl Pictures {
    fn add(&mut self, image: &EpisodeImage) -> opencv::Result<()> {
        let bytes: Vector<u8> = Vector::from_slice(&image.data);
        let picture: Mat = imgcodecs::imdecode(&bytes, imgcodecs::IMREAD_COLOR)?;
        (self.width, self.height) = (picture.cols(), picture.rows());
        let mut planes: Vector<Mat> = Vector::new();
        core::split(&picture, &mut planes)?;
        // OpenCV's order is blue, green, red.
        for (channel, plane) in self.channels.iter_mut().rev().zip(planes) {
            for value in plane.data_bytes()? {
                let v = f64::from(*value) / 255.0;
                channel.min = channel.min.min(v);
                channel.max = channel.max.max(v);
                channel.sum += v;
                channel.squares += v * v;
            }
            channel.count += plane.total() as u64;
        }
        Ok(())
    }

    fn json(&self) -> Value {
        let each =
            |f: &dyn Fn(&Moments) -> f64| self.channels.iter().map(|m| [[if m.count == 0 { 0.0 } else { f(m) }]]).collect::<Vec<_>>();
        let pixels = self.width as u64 * self.height as u64;
        json!({
            "min": each(&|m| m.min),
            "max": each(&|m| m.max),
            "mean": each(&Moments::mean),
            "std": each(&Moments::std),
            "count": [self.channels[0].count.checked_div(pixels).unwrap_or(0)],
        })
    }
}

fn make_parent(path: &Path) -> Result<(), ExportError> {
    let parent = path.parent().unwrap_or(path);
    fs::create_dir_all(parent).map_err(|e| write_error(parent, e))
}

fn write_json(path: &Path, value: &Value) -> Result<(), ExportError> {
    make_parent(path)?;
    fs::write(path, format!("{value:#}\n")).map_err(|e| write_error(path, e))
}

fn write_parquet(path: &Path, columns: Vec<(String, Column)>, note: Option<KeyValue>) -> Result<(), ExportError> {
    make_parent(path)?;
    let file = OpenOptions::new().write(true).create_new(true).open(path).map_err(|e| write_error(path, e))?;
    table(file, columns, note).map_err(|e| write_error(path, e))
}

/// One table as a Parquet file with one row group.
fn table(file: fs::File, columns: Vec<(String, Column)>, note: Option<KeyValue>) -> parquet::errors::Result<()> {
    let mut message = "message schema {\n".to_string();
    for (name, column) in &columns {
        message += &match column {
            Column::Int(_) => format!("required int64 {name};\n"),
            Column::Float(_) => format!("required float {name};\n"),
            Column::Double(_) => format!("required double {name};\n"),
            Column::Text(_) => format!("required binary {name} (UTF8);\n"),
            Column::FloatList { .. } => format!("required group {name} (LIST) {{ repeated group list {{ required float element; }} }}\n"),
            Column::TextList(_) => {
                format!("required group {name} (LIST) {{ repeated group list {{ required binary element (UTF8); }} }}\n")
            }
        };
    }
    let schema = Arc::new(parse_message_type(&(message + "}"))?);
    let properties = WriterProperties::builder().set_compression(Compression::UNCOMPRESSED).set_key_value_metadata(note.map(|n| vec![n]));
    let mut writer = SerializedFileWriter::new(file, schema, Arc::new(properties.build()))?;
    let mut group = writer.next_row_group()?;
    let bytes = |texts: Vec<String>| texts.into_iter().map(|t| ByteArray::from(t.into_bytes())).collect::<Vec<_>>();
    for (_, column) in columns {
        let Some(mut writer) = group.next_column()? else { break };
        match column {
            Column::Int(values) => writer.typed::<Int64Type>().write_batch(&values, None, None)?,
            Column::Float(values) => writer.typed::<FloatType>().write_batch(&values, None, None)?,
            Column::Double(values) => writer.typed::<DoubleType>().write_batch(&values, None, None)?,
            Column::Text(texts) => writer.typed::<ByteArrayType>().write_batch(&bytes(texts), None, None)?,
            // Repetition level 0 begins a row; definition level 1 says that the value is there.
            Column::FloatList { width, values } => {
                let repetition: Vec<i16> = (0..values.len()).map(|i| i16::from(i % width != 0)).collect();
                writer.typed::<FloatType>().write_batch(&values, Some(&vec![1; values.len()]), Some(&repetition))?
            }
            Column::TextList(texts) => {
                let n = texts.len();
                writer.typed::<ByteArrayType>().write_batch(&bytes(texts), Some(&vec![1; n]), Some(&vec![0; n]))?
            }
        };
        writer.close()?;
    }
    group.close()?;
    writer.close().map(drop)
}
