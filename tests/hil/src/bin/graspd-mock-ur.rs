//! A mock Universal Robots controller; see `graspd_hil::controller`.

fn main() -> std::process::ExitCode {
    let code = graspd_hil::controller::main_with_args(std::env::args_os());
    std::process::ExitCode::from(u8::try_from(code).unwrap_or(1))
}
