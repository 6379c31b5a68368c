//! Numbers of things in messages: "1 episode", "2 episodes". Any thread that may allocate; nothing here fails.

use std::fmt::Display;

/// `n` and the word for so many of what one is called `one`: an s is added for all numbers but 1.
pub fn counted<N: Display + PartialEq + From<u8>>(n: N, one: &str) -> String {
    let s = if n == N::from(1) { "" } else { "s" };
    format!("{n} {one}{s}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects messages from "1 episodes", whatever the number's type.
    #[test]
    fn one_is_singular() {
        assert_eq!(
            (counted(0_u64, "day"), counted(1_usize, "day"), counted(2_u32, "day")),
            ("0 days".into(), "1 day".into(), "2 days".into())
        );
    }
}
