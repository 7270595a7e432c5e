//! Duration of reading and writing a package: `cargo bench -p graspd-rt --bench rtde`. Prints minimum and median of
//! many batches, ns per package, and the number of allocations, which is zero.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use std::alloc::{GlobalAlloc, Layout, System};
use std::hint::black_box;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use graspd_rt::arm::{ArmCommand, ArmMode};
use graspd_rt::rtde::*;

struct Counting;
static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

// SAFETY: both calls are handed to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, p: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(p, layout) }
    }
}

#[global_allocator]
static GLOBAL: Counting = Counting;

fn measure(what: &str, mut work: impl FnMut()) {
    const BATCH: u32 = 1000;
    let mut times = [0f64; 501];
    let before = ALLOCATIONS.load(Ordering::Relaxed);
    for t in &mut times {
        let start = Instant::now();
        for _ in 0..BATCH {
            work();
        }
        *t = start.elapsed().as_nanos() as f64 / f64::from(BATCH);
    }
    let allocations = ALLOCATIONS.load(Ordering::Relaxed) - before;
    times.sort_by(f64::total_cmp);
    println!("{what:58} best {:6.1} ns  median {:6.1} ns  allocations {allocations}", times[0], times[times.len() / 2]);
}

const TYPICAL: &str = "timestamp,actual_q,actual_qd,target_q,target_qd,robot_mode,safety_status_bits,runtime_state,\
output_int_register_24,output_double_register_24,output_double_register_25,output_double_register_26,\
output_double_register_27,output_double_register_28,output_double_register_29";

/// A stream of one data package, and its reader.
fn data(recipe: &Recipe<64>) -> Vec<u8> {
    let values: Vec<u8> = (0..recipe.size()).map(|i| (i % 63) as u8).collect();
    let mut bytes = vec![0u8; 1024];
    let n = ControllerMessage::Data { recipe: Some(1), values: &values }.emit(Version::V2, &mut bytes).unwrap();
    bytes.truncate(n);
    bytes
}

fn main() {
    let recipe = Recipe::<64>::parse(Side::Output, TYPICAL).unwrap();
    let bytes = data(&recipe);
    assert_eq!(bytes.len(), 268);
    let time = recipe.slot::<f64>("timestamp").unwrap();
    let vectors = ["actual_q", "actual_qd", "target_q", "target_qd"].map(|n| recipe.slot::<[f64; 6]>(n).unwrap());
    let mode = recipe.slot::<i32>("robot_mode").unwrap();
    let words = ["safety_status_bits", "runtime_state"].map(|n| recipe.slot::<u32>(n).unwrap());
    let echo = recipe.slot::<i32>("output_int_register_24").unwrap();
    let doubles: Vec<_> =
        (24..30).map(|n| recipe.slot::<f64>(&format!("output_double_register_{n}")).unwrap()).collect();
    let mut framer = Framer::new(vec![0u8; MAX_PACKAGE]);
    measure("frame, parse and read all 15 fields of 268 bytes", || {
        framer.feed(black_box(&bytes));
        let package = framer.next().unwrap().unwrap();
        let Ok(ControllerMessage::Data { values, .. }) = ControllerMessage::parse(Version::V2, package) else { return };
        black_box(time.read(values));
        for v in &vectors {
            black_box(v.read(values));
        }
        black_box(mode.read(values));
        for w in &words {
            black_box(w.read(values));
        }
        black_box(echo.read(values));
        for d in &doubles {
            black_box(d.read(values));
        }
    });

    let recipe = Recipe::<64>::resolve(Side::Output, &STATE_FIELDS).unwrap();
    let bytes = data(&recipe);
    let reader = StateReader::new(&recipe).unwrap();
    measure("frame, parse and read our 17 fields into RobotState", || {
        framer.feed(black_box(&bytes));
        let package = framer.next().unwrap().unwrap();
        let Ok(ControllerMessage::Data { values, .. }) = ControllerMessage::parse(Version::V2, package) else { return };
        black_box(reader.read(values, 1));
    });

    let seven = Recipe::<64>::parse(
        Side::Input,
        "input_int_register_24,input_double_register_24,input_double_register_25,input_double_register_26,\
         input_double_register_27,input_double_register_28,input_double_register_29",
    )
    .unwrap();
    let int = seven.slot::<i32>("input_int_register_24").unwrap();
    let rates: Vec<_> = (24..30).map(|n| seven.slot::<f64>(&format!("input_double_register_{n}")).unwrap()).collect();
    let mut out = [0u8; 256];
    let mut values = [0u8; 52];
    measure("write 1 int and 6 doubles and emit their package", || {
        int.write(&mut values, black_box(7));
        for (slot, i) in rates.iter().zip(0..) {
            slot.write(&mut values, black_box(f64::from(i)));
        }
        black_box(ClientMessage::Data { recipe: 1, values: &values }.emit(Version::V2, &mut out).unwrap());
    });

    let writer = CommandWriter::new(1, 99, 10.0);
    let command = ArmCommand { mode: ArmMode::Velocity, rates: [0.1; 6], heartbeat: 3, outputs: 0 };
    measure("emit our whole command (4 ints, 13 doubles)", || {
        black_box(writer.write(black_box(&command), None, &mut out).unwrap());
    });
}
