//! Evaluation of pours: on many rigs, episodes are recorded, a method is trained on them, and it pours goals that it never saw.
//!
//! Training sees only the episodes; the truth is used for nothing but the error.
//!
//! | file | what it holds |
//! |---|---|
//! | [`pourer`] | what pours: trained methods and baselines |
//! | [`change`] | what is different at the test from what the training saw |
//! | [`trial`] | one rig and one set of episodes: recorded, trained and tested |
//! | `first_hour` | the demo without its processes |
//! | [`summary`] | the errors of one method over all trials |

pub mod change;
mod first_hour;
pub mod pourer;
pub mod summary;
pub mod trial;
