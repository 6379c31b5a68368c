//! The messages of episodes in format 1, which were JSON. They are only read, never written.
//!
//! `null` stood for NaN. It allocates and is for ordinary threads only. A message that does not fit is an error in words.

use serde::{Deserialize, Deserializer};

use super::format::{RowMessage, TelemetryMessage};

/// A message of `/sample`: one row of `L_E`, with V_e beside it.
#[derive(Deserialize)]
struct RowJson {
    sequence: u64,
    captured_at_ns: u64,
    #[serde(deserialize_with = "null_is_nan")]
    alpha_commanded_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    alpha_measured_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    area_px2: f32,
    doubt: String,
    image: bool,
}

/// What a reader needs of a message of `/telemetry`: one tick.
#[derive(Deserialize)]
struct TelemetryJson {
    tick: u64,
    at_ns: u64,
    robot_at_ns: u64,
    #[serde(deserialize_with = "null_is_nan")]
    alpha_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    alpha_measured_deg: f32,
}

/// A number in which `null` stands for NaN, which JSON does not have.
fn null_is_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
    Ok(Option::<f32>::deserialize(deserializer)?.unwrap_or(f32::NAN))
}

/// A row of format 1.
pub(super) fn row(data: &[u8]) -> Result<RowMessage, String> {
    let row: RowJson = serde_json::from_slice(data).map_err(|e| e.to_string())?;
    Ok(RowMessage {
        sequence: row.sequence,
        captured_at_ns: row.captured_at_ns,
        alpha_commanded_deg: row.alpha_commanded_deg,
        alpha_measured_deg: row.alpha_measured_deg,
        area_px2: row.area_px2,
        doubt: row.doubt,
        image: row.image,
    })
}

/// A tick of format 1, as far as it is used.
pub(super) fn tick(data: &[u8]) -> Result<TelemetryMessage, String> {
    let tick: TelemetryJson = serde_json::from_slice(data).map_err(|e| e.to_string())?;
    Ok(TelemetryMessage {
        tick: tick.tick,
        at_ns: tick.at_ns,
        robot_at_ns: tick.robot_at_ns,
        alpha_deg: tick.alpha_deg,
        alpha_measured_deg: tick.alpha_measured_deg,
        poured_ml: f32::NAN,
        ..Default::default()
    })
}
