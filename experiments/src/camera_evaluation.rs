//! Evaluation of the camera's side: the feature extraction is measured against rendered truth.
//!
//! The renderer's truth is the line along the outline that it drew; the renderer shares nothing with the extraction.
//!
//! | file | what it holds |
//! |---|---|
//! | [`cases`] | cells as they differ: liquid, background, light, noise, blur, lip, each with a name |
//! | [`scenes`] | what happens before the camera: short scenes and whole pours |
//! | [`measure`] | renders and measures scenes frame by frame |
//! | [`figures`] | errors and rates of many measured frames |
//! | [`worst`] | the worst frames, with what was seen and the truth drawn on them |
//! | [`doubts`] | frames that nobody should trust, and whether the doubt is raised |
//! | [`faults`] | whole pours through cameras with the faults that people report |

pub mod cases;
pub mod doubts;
pub mod faults;
pub mod figures;
pub mod measure;
pub mod scenes;
pub mod worst;
