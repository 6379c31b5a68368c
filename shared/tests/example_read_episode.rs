//! The example `read_episode`, run as a person without an episode runs it.

#[path = "../examples/read_episode.rs"]
#[allow(dead_code)]
mod read_episode;

/// Protects people who copy the example: it writes, reads and describes an episode as its header promises.
#[test]
fn the_example_describes_the_episode_that_it_writes() {
    let directory = tempfile::tempdir().unwrap();
    let file = read_episode::write_small_episode(directory.path()).unwrap();
    let text = read_episode::describe(&file).unwrap();
    assert!(text.starts_with("a recording of eq. (1) up to 60 degrees"), "{text}");
    assert!(text.contains("12 rows, sum of V_e ") && text.contains("weight 12.5 g"), "{text}");
    assert_eq!(text.matches("lost").count(), 1, "{text}");
    assert!(text.ends_with("it can be trained on\n"), "{text}");
}
