//! Writes the manual pages and the shells' completions of all programs into a directory, from their command lines:
//! `cargo run --release -p decant --example manuals -- DIRECTORY`. `scripts/package` puts them into the package.
//!
//! Short ordinary process; allocates. It fails with one line when a file cannot be written.

use std::path::Path;
use std::process::ExitCode;

use clap::{Command, CommandFactory as _};
use clap_complete::Shell;
use shared::exit::{self, BAD_INPUT, Failure, OrExit as _, failure};

fn main() -> ExitCode {
    exit::end(match std::env::args_os().nth(1) {
        Some(directory) => write_all(Path::new(&directory)),
        None => Err(failure(BAD_INPUT, "give the directory to write into")),
    })
}

/// Writes the pages and completions of each program.
fn write_all(directory: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(directory).or_exit(exit::FAILED)?;
    let mut programs = vec![
        rt_controller::cli::Cli::command(),
        feature_worker::cli::Cli::command(),
        trainer::cli::Cli::command(),
        operator_page::cli::Cli::command(),
    ];
    programs.push(decant::programs::with_commands(decant::cli::Cli::command(), &programs));
    for command in programs {
        // A page a command: decant(1), rt-controller(1), rt-controller-pour(1) and so on.
        let name = command.get_name().to_owned();
        let mut command: Command = command.bin_name(&name);
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            clap_complete::generate_to(shell, &mut command, &name, directory).or_exit(exit::FAILED)?;
        }
        clap_mangen::generate_to(command, directory).or_exit(exit::FAILED)?;
    }
    Ok(())
}
