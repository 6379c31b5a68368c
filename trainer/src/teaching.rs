//! What weighed episodes teach about the camera, what they leave open, and what to record next.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail.
//!
//! | file | what it holds |
//! |---|---|
//! | [`span`] | which streams an episode shows: its volume by area and tilt |
//! | [`doubt`] | how wrong the camera's volume may still be at each area and tilt, after what was weighed |
//! | [`foresight`] | which streams a curve or a pour to come will show, by the fitted flow model |
//! | [`gaps`] | what areas, weights and fills are not spanned, in words |
//! | [`plan`] | the curve or pour that takes most of the doubt about the pours to come |
//!
//! The reasoning is that of a linear design of experiments. A weight says what the volumes of an episode's streams come to, and so it says
//! something about all streams that are alike. What is recorded next is what leaves the least doubt about the pours to come.

pub mod doubt;
pub mod foresight;
pub mod gaps;
pub mod plan;
pub mod span;
