//! Writes a table as a Parquet file with one row group. Runs on the command's thread and allocates; a file that exists already is an error.

use std::fs::{self, OpenOptions};
use std::path::Path;
use std::sync::Arc;

use parquet::basic::Compression;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DoubleType, FloatType, Int64Type};
use parquet::errors::{ParquetError, Result as ParquetResult};
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::parser::parse_message_type;

use shared::disk_space::error_words;

use crate::episodes::output::{ExportError, disk_error, make_parent, write_error};

/// The values of one column. All columns of a table have the same number of rows.
pub enum Column {
    /// Whole numbers.
    Int(Vec<i64>),
    /// Numbers of 32 bits.
    Float(Vec<f32>),
    /// Numbers of 64 bits.
    Double(Vec<f64>),
    /// Numbers of 64 bits, of which some are not there.
    OptionalDouble(Vec<Option<f64>>),
    /// Texts.
    Text(Vec<String>),
    /// Rows of `width` values each.
    FloatList {
        /// Values in each row.
        width: usize,
        /// All rows, one after the other.
        values: Vec<f32>,
    },
    /// Rows of `width` marks each.
    BoolList {
        /// Values in each row.
        width: usize,
        /// All rows, one after the other.
        values: Vec<bool>,
    },
    /// Rows of `width` values each.
    DoubleList {
        /// Values in each row.
        width: usize,
        /// All rows, one after the other.
        values: Vec<f64>,
    },
    /// Rows of a list with one number each.
    IntList(Vec<i64>),
    /// Rows of `width` lists of one list of one value each: a number for each channel of an image, as LeRobot has them.
    ChannelList {
        /// Channels.
        width: usize,
        /// All rows, one after the other.
        values: Vec<f64>,
    },
    /// Rows of a list with one text each.
    TextList(Vec<String>),
}

impl Column {
    /// The column `name` in Parquet's schema language.
    fn schema(&self, name: &str) -> String {
        let list = |element: &str| format!("required group {name} (LIST) {{ repeated group list {{ required {element}; }} }}\n");
        match self {
            Self::Int(_) => format!("required int64 {name};\n"),
            Self::Float(_) => format!("required float {name};\n"),
            Self::Double(_) => format!("required double {name};\n"),
            Self::OptionalDouble(_) => format!("optional double {name};\n"),
            Self::BoolList { .. } => list("boolean element"),
            Self::DoubleList { .. } => list("double element"),
            Self::IntList(_) => list("int64 element"),
            Self::ChannelList { .. } => format!(
                "required group {name} (LIST) {{ repeated group list {{ required group element (LIST) {{ repeated group list {{ \
                 required group element (LIST) {{ repeated group list {{ required double element; }} }} }} }} }} }}\n"
            ),
            Self::Text(_) => format!("required binary {name} (UTF8);\n"),
            Self::FloatList { .. } => list("float element"),
            Self::TextList(_) => list("binary element (UTF8)"),
        }
    }

    /// Writes the values. In a list, repetition level 0 begins a row and definition level 1 says that the value is there.
    fn write(self, writer: &mut SerializedColumnWriter) -> ParquetResult<usize> {
        let bytes = |texts: Vec<String>| texts.into_iter().map(|t| ByteArray::from(t.into_bytes())).collect::<Vec<_>>();
        match self {
            Self::Int(values) => writer.typed::<Int64Type>().write_batch(&values, None, None),
            Self::Float(values) => writer.typed::<FloatType>().write_batch(&values, None, None),
            Self::Double(values) => writer.typed::<DoubleType>().write_batch(&values, None, None),
            Self::Text(texts) => writer.typed::<ByteArrayType>().write_batch(&bytes(texts), None, None),
            Self::OptionalDouble(values) => {
                let there: Vec<i16> = values.iter().map(|v| i16::from(v.is_some())).collect();
                let values: Vec<f64> = values.into_iter().flatten().collect();
                writer.typed::<DoubleType>().write_batch(&values, Some(&there), None)
            }
            Self::FloatList { width, values } => {
                writer.typed::<FloatType>().write_batch(&values, Some(&vec![1; values.len()]), Some(&repetition(width, values.len())))
            }
            Self::BoolList { width, values } => {
                writer.typed::<BoolType>().write_batch(&values, Some(&vec![1; values.len()]), Some(&repetition(width, values.len())))
            }
            Self::DoubleList { width, values } => {
                writer.typed::<DoubleType>().write_batch(&values, Some(&vec![1; values.len()]), Some(&repetition(width, values.len())))
            }
            Self::IntList(values) => {
                writer.typed::<Int64Type>().write_batch(&values, Some(&vec![1; values.len()]), Some(&vec![0; values.len()]))
            }
            // A list in a list in a list: each value is there by level 3, and is the only one of its two inner lists.
            Self::ChannelList { width, values } => {
                writer.typed::<DoubleType>().write_batch(&values, Some(&vec![3; values.len()]), Some(&repetition(width, values.len())))
            }
            Self::TextList(texts) => {
                let n = texts.len();
                writer.typed::<ByteArrayType>().write_batch(&bytes(texts), Some(&vec![1; n]), Some(&vec![0; n]))
            }
        }
    }
}

/// Repetition levels of `values` values in rows of `width`.
fn repetition(width: usize, values: usize) -> Vec<i16> {
    (0..values).map(|i| i16::from(i % width != 0)).collect()
}

/// Writes `columns`, each with its name, to the new file `path`, with a `note` in the file's metadata.
pub fn write_parquet(path: &Path, columns: Vec<(String, Column)>, note: Option<KeyValue>) -> Result<(), ExportError> {
    make_parent(path)?;
    let file = OpenOptions::new().write(true).create_new(true).open(path).map_err(|e| disk_error(path, &e))?;
    write_columns(file, columns, note).map_err(|e| {
        // It was not there before, so it is ours, and nobody needs a part of it.
        let _ = fs::remove_file(path);
        write_error(path, words(&e))
    })
}

/// An error of the parquet crate in words. What the disk said is inside of it.
fn words(e: &ParquetError) -> String {
    match e {
        ParquetError::External(inner) => inner.downcast_ref().map_or_else(|| e.to_string(), error_words),
        e => e.to_string(),
    }
}

fn write_columns(file: fs::File, columns: Vec<(String, Column)>, note: Option<KeyValue>) -> ParquetResult<()> {
    let fields: String = columns.iter().map(|(name, column)| column.schema(name)).collect();
    let schema = Arc::new(parse_message_type(&format!("message schema {{\n{fields}}}"))?);
    let properties = WriterProperties::builder().set_compression(Compression::UNCOMPRESSED).set_key_value_metadata(note.map(|n| vec![n]));
    let mut writer = SerializedFileWriter::new(file, schema, Arc::new(properties.build()))?;
    let mut group = writer.next_row_group()?;
    for (_, column) in columns {
        let Some(mut column_writer) = group.next_column()? else { break };
        column.write(&mut column_writer)?;
        column_writer.close()?;
    }
    group.close()?;
    writer.close().map(drop)
}
