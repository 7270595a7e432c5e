//! Two simulated cameras: see `graspd-scene --help`.

fn main() -> std::process::ExitCode {
    let code = graspd_hil::scene_program::main_with_args(std::env::args_os());
    std::process::ExitCode::from(u8::try_from(code).unwrap_or(1))
}
