//! The schemas that make an episode's file describe itself: for each topic the FileDescriptorSet that MCAP asks of protobuf messages.
//!
//! Foxglove's own messages stand here with all of their fields, by the numbers of its published schemas, also those that are not written. It
//! allocates, never fails, and runs once for each file in an ordinary thread. Tests hold the schemas against the messages in [`format`](super::format).

use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{
    DescriptorProto, EnumDescriptorProto, EnumValueDescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet,
};

use super::format;

/// A field: name, number, type (`name` of a message or enum, or a scalar), whether it is repeated.
type Field = (&'static str, i32, &'static str, bool);

/// `google.protobuf.Timestamp`.
const TIMESTAMP: (&str, &[Field]) = ("Timestamp", &[("seconds", 1, "int64", false), ("nanos", 2, "int32", false)]);

/// `foxglove.CompressedImage`.
const COMPRESSED_IMAGE: &[(&str, &[Field])] = &[(
    "CompressedImage",
    &[
        ("timestamp", 1, ".google.protobuf.Timestamp", false),
        ("frame_id", 4, "string", false),
        ("data", 2, "bytes", false),
        ("format", 3, "string", false),
    ],
)];

/// `foxglove.ImageAnnotations` and what it is made of.
const IMAGE_ANNOTATIONS: &[(&str, &[Field])] = &[
    ("Point2", &[("x", 1, "double", false), ("y", 2, "double", false)]),
    ("Color", &[("r", 1, "double", false), ("g", 2, "double", false), ("b", 3, "double", false), ("a", 4, "double", false)]),
    ("KeyValuePair", &[("key", 1, "string", false), ("value", 2, "string", false)]),
    (
        "CircleAnnotation",
        &[
            ("timestamp", 1, ".google.protobuf.Timestamp", false),
            ("position", 2, ".foxglove.Point2", false),
            ("diameter", 3, "double", false),
            ("thickness", 4, "double", false),
            ("fill_color", 5, ".foxglove.Color", false),
            ("outline_color", 6, ".foxglove.Color", false),
            ("metadata", 7, ".foxglove.KeyValuePair", true),
        ],
    ),
    (
        "PointsAnnotation",
        &[
            ("timestamp", 1, ".google.protobuf.Timestamp", false),
            ("type", 2, ".foxglove.PointsAnnotation.Type", false),
            ("points", 3, ".foxglove.Point2", true),
            ("outline_color", 4, ".foxglove.Color", false),
            ("outline_colors", 5, ".foxglove.Color", true),
            ("fill_color", 6, ".foxglove.Color", false),
            ("thickness", 7, "double", false),
            ("metadata", 8, ".foxglove.KeyValuePair", true),
        ],
    ),
    (
        "TextAnnotation",
        &[
            ("timestamp", 1, ".google.protobuf.Timestamp", false),
            ("position", 2, ".foxglove.Point2", false),
            ("text", 3, "string", false),
            ("font_size", 4, "double", false),
            ("text_color", 5, ".foxglove.Color", false),
            ("background_color", 6, ".foxglove.Color", false),
            ("metadata", 7, ".foxglove.KeyValuePair", true),
        ],
    ),
    (
        "ImageAnnotations",
        &[
            ("timestamp", 5, ".google.protobuf.Timestamp", false),
            ("circles", 1, ".foxglove.CircleAnnotation", true),
            ("points", 2, ".foxglove.PointsAnnotation", true),
            ("texts", 3, ".foxglove.TextAnnotation", true),
            ("metadata", 4, ".foxglove.KeyValuePair", true),
        ],
    ),
];

/// The enum's type, with its values in the order of their numbers.
const POINTS_TYPE: &[&str] = &["UNKNOWN", "POINTS", "LINE_LOOP", "LINE_STRIP", "LINE_LIST"];

/// `decant.Feature`: what the feature worker measured in one frame (V_e, section 3.3.1). Times are CLOCK_MONOTONIC.
const FEATURE: &[(&str, &[Field])] = &[(
    "Feature",
    &[
        ("sequence", 1, "uint64", false),
        ("captured_at_ns", 2, "uint64", false),
        ("received_at_ns", 3, "uint64", false),
        ("published_at_ns", 4, "uint64", false),
        ("worker_epoch_ns", 5, "uint64", false),
        ("area_px2", 6, "float", false),
        ("confidence", 7, "float", false),
        ("doubt", 8, "string", false),
        ("triangle_px", 9, "float", true),
    ],
)];

/// `decant.Telemetry`: what one tick of the controller saw and decided. Times are CLOCK_MONOTONIC; what is not there is NaN.
const TELEMETRY: &[(&str, &[Field])] = &[(
    "Telemetry",
    &[
        ("tick", 1, "uint64", false),
        ("at_ns", 2, "uint64", false),
        ("robot_at_ns", 3, "uint64", false),
        ("feature_sequence", 4, "uint64", false),
        ("phase", 5, "string", false),
        ("alpha_deg", 6, "float", false),
        ("alpha_measured_deg", 7, "float", false),
        ("dalpha_deg", 8, "float", false),
        ("area_px2", 9, "float", false),
        ("v_ml", 10, "float", false),
        ("d_ml", 11, "float", false),
        ("poured_ml", 12, "float", false),
        ("goal_ml", 13, "float", false),
        ("poured_sd_ml", 14, "float", false),
    ],
)];

/// `decant.Sample`: one frame of the episode, alpha at its capture time, and V_e. Times are CLOCK_MONOTONIC; an unknown alpha is NaN.
const SAMPLE: &[(&str, &[Field])] = &[(
    "Sample",
    &[
        ("sequence", 1, "uint64", false),
        ("captured_at_ns", 2, "uint64", false),
        ("alpha_commanded_deg", 3, "float", false),
        ("alpha_measured_deg", 4, "float", false),
        ("area_px2", 5, "float", false),
        ("doubt", 6, "string", false),
        ("image", 7, "bool", false),
    ],
)];

/// Topic, schema's name, and schema of each topic, in the order of [`EpisodeWriter`](super::EpisodeWriter)'s channels.
pub(super) fn channels() -> [(&'static str, &'static str, Vec<u8>); 5] {
    let [foxglove, ours] = ["foxglove", "decant"];
    [
        (format::IMAGE_TOPIC, "foxglove.CompressedImage", set(foxglove, "CompressedImage", COMPRESSED_IMAGE)),
        (format::ANNOTATION_TOPIC, "foxglove.ImageAnnotations", set(foxglove, "ImageAnnotations", IMAGE_ANNOTATIONS)),
        (format::FEATURE_TOPIC, "decant.Feature", set(ours, "Feature", FEATURE)),
        (format::TELEMETRY_TOPIC, "decant.Telemetry", set(ours, "Telemetry", TELEMETRY)),
        (format::ROW_TOPIC, "decant.Sample", set(ours, "Sample", SAMPLE)),
    ]
}

/// The schema of one file of messages, with the file of time stamps where they are used.
fn set(package: &str, name: &str, messages: &[(&str, &[Field])]) -> Vec<u8> {
    let stamped = messages.iter().any(|(_, fields)| fields.iter().any(|f| f.2 == ".google.protobuf.Timestamp"));
    let stamp_file = "google/protobuf/timestamp.proto";
    let file = |name: String, package: &str, dependency: Vec<String>, messages: &[(&str, &[Field])]| FileDescriptorProto {
        name: Some(name),
        package: Some(package.into()),
        dependency,
        message_type: messages.iter().map(message).collect(),
        syntax: Some("proto3".into()),
        ..Default::default()
    };
    let mut files = Vec::new();
    if stamped {
        files.push(file(stamp_file.into(), "google.protobuf", Vec::new(), &[TIMESTAMP]));
    }
    let dependency = if stamped { vec![stamp_file.into()] } else { Vec::new() };
    files.push(file(format!("{package}/{name}.proto"), package, dependency, messages));
    FileDescriptorSet { file: files }.encode_to_vec()
}

/// One message.
fn message((name, fields): &(&str, &[Field])) -> DescriptorProto {
    let mut message = DescriptorProto { name: Some((*name).into()), field: fields.iter().map(field).collect(), ..Default::default() };
    if *name == "PointsAnnotation" {
        let value = |(number, name): (usize, &&str)| EnumValueDescriptorProto {
            name: Some((*name).into()),
            number: i32::try_from(number).ok(),
            ..Default::default()
        };
        message.enum_type = vec![EnumDescriptorProto {
            name: Some("Type".into()),
            value: POINTS_TYPE.iter().enumerate().map(value).collect(),
            ..Default::default()
        }];
    }
    message
}

/// One field.
fn field(&(name, number, kind, repeated): &Field) -> FieldDescriptorProto {
    let scalar = match kind {
        "int64" => Type::Int64,
        "int32" => Type::Int32,
        "uint64" => Type::Uint64,
        "float" => Type::Float,
        "double" => Type::Double,
        "bool" => Type::Bool,
        "string" => Type::String,
        "bytes" => Type::Bytes,
        _ if kind.ends_with(".Type") => Type::Enum,
        _ => Type::Message,
    };
    FieldDescriptorProto {
        name: Some(name.into()),
        number: Some(number),
        label: Some(if repeated { Label::Repeated } else { Label::Optional }.into()),
        r#type: Some(scalar.into()),
        type_name: kind.starts_with('.').then(|| kind.into()),
        ..Default::default()
    }
}

#[cfg(test)]
mod tests {
    use prost_reflect::{DescriptorPool, DynamicMessage, Value};

    use super::*;
    use crate::messages::{Doubt, Feature, Telemetry};

    /// Reads `bytes` by the schema in the file alone, as a foreign program does, and gives it as text.
    fn foreign(topic: &str, bytes: &[u8]) -> String {
        let (_, name, schema) = channels().into_iter().find(|c| c.0 == topic).expect("a topic");
        let pool = DescriptorPool::decode(schema.as_slice()).expect("a sound set");
        let message = DynamicMessage::decode(pool.get_message_by_name(name).expect("the message"), bytes).expect("it fits");
        assert_eq!(message.unknown_fields().count(), 0, "{name} writes a field that its schema does not have");
        text(&Value::Message(message))
    }

    /// A value in words, without spaces.
    fn text(value: &Value) -> String {
        match value {
            Value::Message(m) => {
                format!(
                    "{{{}}}",
                    m.fields().map(|(field, value)| format!("{}:{}", field.name(), text(value))).collect::<Vec<_>>().join(",")
                )
            }
            Value::List(values) => format!("[{}]", values.iter().map(text).collect::<Vec<_>>().join(",")),
            Value::EnumNumber(n) => n.to_string(),
            Value::I32(n) => n.to_string(),
            Value::I64(n) => n.to_string(),
            Value::U64(n) => n.to_string(),
            Value::F32(n) => n.to_string(),
            Value::F64(n) => n.to_string(),
            Value::Bool(b) => b.to_string(),
            Value::String(s) => s.clone(),
            other => format!("{other:?}"),
        }
    }

    /// Protects viewers and other readers: by its schema alone each message reads as what was written, field by field, also where a number is
    /// unknown.
    #[test]
    fn a_foreign_reader_finds_features_and_triangle() {
        let triangle_px = [1.5, 2.5, 3.5, 4.5, 5.5, 6.5];
        let f = Feature {
            doubt: Doubt::Blurred as u32,
            sequence: 11,
            worker_epoch_ns: 12,
            captured_at_ns: 13,
            received_at_ns: 14,
            published_at_ns: 15,
            area_px2: 16.5,
            confidence: 0.25,
            triangle_px,
            ..Default::default()
        };
        let text = foreign(format::FEATURE_TOPIC, &format::FeatureMessage::new(&f).encode_to_vec());
        for field in [
            "sequence:11",
            "worker_epoch_ns:12",
            "captured_at_ns:13",
            "received_at_ns:14",
            "published_at_ns:15",
            "area_px2:16.5",
            "confidence:0.25",
            "doubt:blurred",
            "triangle_px:[1.5,2.5,3.5,4.5,5.5,6.5]",
        ] {
            assert!(text.contains(field), "{field}: {text}");
        }
        let text = foreign(format::ANNOTATION_TOPIC, &format::ImageAnnotations::new(&f, 7_000_000_009).encode_to_vec());
        for field in ["type:2", "seconds:7,nanos:9", "points:[{x:1.5,y:2.5},{x:3.5,y:4.5},{x:5.5,y:6.5}]", "text:blurred"] {
            assert!(text.contains(field), "{field}: {text}");
        }
    }

    /// Protects viewers and other readers: the same of ticks.
    #[test]
    fn a_foreign_reader_finds_ticks() {
        let t = Telemetry {
            phase: 2,
            tick: 1,
            at_ns: 2,
            robot_at_ns: 3,
            feature_sequence: 4,
            alpha_deg: 5.5,
            alpha_measured_deg: 6.5,
            dalpha_deg: f32::NAN,
            area_px2: 7.5,
            v_ml: 8.5,
            d_ml: 9.5,
            poured_ml: 10.5,
            goal_ml: 11.5,
            poured_sd_ml: 12.5,
            ..Default::default()
        };
        let text = foreign(format::TELEMETRY_TOPIC, &format::TelemetryMessage::new(&t).encode_to_vec());
        for field in [
            "tick:1",
            "at_ns:2",
            "robot_at_ns:3",
            "feature_sequence:4",
            "phase:pouring",
            "alpha_deg:5.5",
            "alpha_measured_deg:6.5",
            "dalpha_deg:nan",
            "area_px2:7.5",
            "v_ml:8.5",
            "d_ml:9.5",
            "poured_ml:10.5",
            "goal_ml:11.5",
            "poured_sd_ml:12.5",
        ] {
            assert!(text.to_lowercase().contains(field), "{field}: {text}");
        }
    }

    /// Protects viewers and other readers: the same of rows and images.
    #[test]
    fn a_foreign_reader_finds_rows_and_images() {
        let row = format::RowMessage {
            sequence: 1,
            captured_at_ns: 2,
            alpha_commanded_deg: 3.5,
            alpha_measured_deg: f32::NAN,
            area_px2: 4.5,
            doubt: "none".into(),
            image: true,
        };
        let text = foreign(format::ROW_TOPIC, &row.encode_to_vec());
        for field in [
            "sequence:1",
            "captured_at_ns:2",
            "alpha_commanded_deg:3.5",
            "alpha_measured_deg:nan",
            "area_px2:4.5",
            "doubt:none",
            "image:true",
        ] {
            assert!(text.to_lowercase().contains(field), "{field}: {text}");
        }
        let image =
            format::CompressedImage { timestamp: Some(format::timestamp(5)), data: vec![1], format: "png".into(), frame_id: "c".into() };
        let text = foreign(format::IMAGE_TOPIC, &image.encode_to_vec());
        assert!(text.contains("nanos:5") && text.contains("format:png") && text.contains("frame_id:c"), "{text}");
    }
}
