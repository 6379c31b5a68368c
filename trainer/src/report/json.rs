//! Reads the values of a report's JSON. What is missing or of another kind becomes a blank, so that a page can be made of files of
//! other versions.
//!
//! Pure functions, for any thread. They allocate and do not fail.

use serde_json::Value;

/// The items of an array; none if it is not an array.
pub fn items(v: &Value) -> impl Iterator<Item = &Value> {
    v.as_array().into_iter().flatten()
}

/// A number; NaN if it is not a number.
pub fn number(v: &Value) -> f64 {
    v.as_f64().unwrap_or(f64::NAN)
}

/// The numbers of an array.
pub fn numbers(v: &Value) -> Vec<f64> {
    items(v).map(number).collect()
}

/// A text as it is, and anything else as JSON.
pub fn text(v: &Value) -> String {
    v.as_str().map_or_else(|| v.to_string(), str::to_owned)
}

/// A number with this many digits after the point; a dash if it is not a number.
pub fn rounded(v: &Value, digits: usize) -> String {
    v.as_f64().map_or_else(|| "-".into(), |x| format!("{x:.digits$}"))
}
