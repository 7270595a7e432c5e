//! The crate's only unsafe code: the few calls that no safe wrapper offers.

/// Puts the calling thread under SCHED_FIFO with this priority (1 to 99).
///
/// # Errors
/// The operating system's refusal, most often EPERM where RLIMIT_RTPRIO is 0.
pub(super) fn set_fifo(priority: u8) -> std::io::Result<()> {
    let param = libc::sched_param { sched_priority: i32::from(priority) };
    // SAFETY: pid 0 names the calling thread, and `param` is a live, initialised sched_param for the length of the call,
    // which the kernel only reads.
    let rc = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const param) };
    if rc == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
}

/// Ends the process at once: no destructor, no exit handler, no flushing, each of which a stuck thread could hold up.
pub fn exit_now(code: u8) -> ! {
    // SAFETY: `_exit` takes any number, touches no memory of ours and does not return.
    unsafe { libc::_exit(i32::from(code)) }
}

/// Lets a write to a terminal from the background go through (with `stty tostop` the kernel would stop the whole process for it).
pub fn ignore_background_writes() {
    // SAFETY: SIG_IGN is a valid disposition for SIGTTOU, and no handler of ours is involved.
    unsafe {
        libc::signal(libc::SIGTTOU, libc::SIG_IGN);
    }
}

/// Page faults (minor, major) and involuntary context switches of the calling thread so far.
pub fn thread_faults() -> (u64, u64, u64) {
    let mut u = std::mem::MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: the pointer is to writable memory of the right size, and the kernel fills it completely on success; on failure
    // the zeroes of `zeroed` stand, and all-zero is a valid rusage.
    let u = unsafe {
        libc::getrusage(libc::RUSAGE_THREAD, u.as_mut_ptr());
        u.assume_init()
    };
    let n = |v: libc::c_long| u64::try_from(v).unwrap_or(0);
    (n(u.ru_minflt), n(u.ru_majflt), n(u.ru_nivcsw))
}
