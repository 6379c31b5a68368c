//! Which program has which command: `decant pour 75` is `rt-controller pour 75`.
//!
//! The program takes the place of this process, so that signals, standard streams and exit codes are its own. It is looked for beside
//! `decant`, and then where the shell looks. Allocates; it fails with one line when there is no such command or program.

use std::ffi::OsString;
use std::os::unix::process::CommandExt as _;
use std::process::Command;

use shared::exit::{BAD_INPUT, Failure, failure};

/// The operator's commands: their name here, the program, its command, and what it is for.
const COMMANDS: [(&str, &str, &str, &str); 21] = [
    ("controller", "rt-controller", "run", "runs the controller of the cell"),
    ("worker", "feature-worker", "run", "runs the cell's camera process"),
    ("pour", "rt-controller", "pour", "pours an exact volume"),
    ("record", "rt-controller", "record", "records one curve to learn from"),
    ("abort", "rt-controller", "abort", "brings the container upright at once"),
    ("resume", "rt-controller", "resume", "takes the robot back after a person had it in hand"),
    ("status", "rt-controller", "status", "shows what the controller does and counts"),
    ("replay", "rt-controller", "replay", "runs a journal again and compares every answer"),
    ("step", "rt-controller", "step", "runs the controller's core for another simulator"),
    ("camera", "feature-worker", "camera", "lists cameras, and who uses them"),
    ("calibrate", "feature-worker", "calibrate", "finds the container's axes and the liquid's colour"),
    ("view", "feature-worker", "view", "shows the camera and what is measured, in a browser"),
    ("page", "operator-page", "run", "serves the operator's page: pour, stop, weigh and learn in a browser"),
    ("inspect", "feature-worker", "inspect", "measures images or a video"),
    ("episodes", "feature-worker", "episodes", "lists, shows, weighs, exports, recovers, prunes and merges episodes"),
    ("plan", "trainer", "plan", "says what to record or pour next"),
    ("check", "trainer", "check", "says what is wrong with a data set"),
    ("train", "trainer", "train", "trains weights from episodes"),
    ("refine", "trainer", "refine", "trains again with all weighed episodes"),
    ("weights", "trainer", "inspect", "prints everything in a weight file"),
    ("report", "trainer", "report", "writes a page of a training or evaluation"),
];

/// The list of commands, as `decant --help` shows it.
pub fn help() -> String {
    let lines = COMMANDS.map(|(name, program, command, what)| format!("  {name:<11} {what} ({program} {command})"));
    format!("Commands of the other programs (`decant COMMAND --help` has more):\n{}\n\n{}", lines.join("\n"), shared::exit::HELP)
}

/// The command line `decant` with the commands of the other `programs` in it, for manual pages and completions. They are not in it when it is read,
/// because each program reads its own.
pub fn with_commands(decant: clap::Command, programs: &[clap::Command]) -> clap::Command {
    let theirs = COMMANDS.iter().filter_map(|(name, program, command, _)| {
        let program = programs.iter().find(|known| known.get_name() == *program)?;
        Some(program.find_subcommand(command)?.clone().name(*name))
    });
    decant.subcommands(theirs).after_help(shared::exit::HELP)
}

/// Runs the command whose name is the first of `words`. Returns only when that fails.
pub fn run(words: &[OsString]) -> Result<(), Failure> {
    let (name, rest) = words.split_first().ok_or_else(|| failure(BAD_INPUT, "give a command; `decant --help` lists them"))?;
    let known = COMMANDS.iter().find(|(command, ..)| name.to_str() == Some(command));
    let Some((_, program, command, _)) = known else {
        return Err(failure(BAD_INPUT, format!("there is no command '{}'; `decant --help` lists them", name.display())));
    };
    let beside = std::env::current_exe().ok().and_then(|own| Some(own.parent()?.join(program))).filter(|path| path.exists());
    let failed = Command::new(beside.unwrap_or_else(|| program.into())).arg(command).args(rest).exec();
    Err(failure(shared::exit::FAILED, format!("{program}: {failed}; it belongs beside decant")))
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    /// Protects who types a command with the shell's help, or reads its manual page: every command of `decant` is there, as the program that has it takes it,
    /// with what lies below.
    #[test]
    fn completions_and_manuals_know_every_command() {
        let programs = [
            rt_controller::cli::Cli::command(),
            feature_worker::cli::Cli::command(),
            trainer::cli::Cli::command(),
            operator_page::cli::Cli::command(),
        ];
        let mut whole = with_commands(crate::cli::Cli::command(), &programs);
        whole.build();
        for (name, program, command, _) in COMMANDS {
            let ours = whole.find_subcommand(name).unwrap_or_else(|| panic!("decant {name} is missing"));
            let theirs = programs.iter().find(|p| p.get_name() == program).unwrap().find_subcommand(command).unwrap();
            assert!(theirs.get_arguments().all(|arg| ours.get_arguments().any(|own| own.get_id() == arg.get_id())), "{name}");
        }
        assert!(whole.find_subcommand("doctor").is_some());
        let mut bash = Vec::new();
        clap_complete::generate(clap_complete::Shell::Bash, &mut whole, "decant", &mut bash);
        let bash = String::from_utf8(bash).unwrap();
        assert!(bash.contains("decant__subcmd__pour") && bash.contains("decant__subcmd__episodes__subcmd__export"), "{bash}");
    }
}
