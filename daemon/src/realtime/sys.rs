//! The only unsafe code of the crate: system calls without a safe wrapper.

/// Schedules the calling thread with SCHED_FIFO at this priority (1 to 99).
///
/// # Errors
/// The error of the operating system, usually EPERM where RLIMIT_RTPRIO is 0.
pub(super) fn set_fifo(priority: u8) -> std::io::Result<()> {
    let param = libc::sched_param { sched_priority: i32::from(priority) };
    // SAFETY: pid 0 names the calling thread, and `param` is a live, initialised sched_param for the length of the
    // call, which the kernel only reads.
    let rc = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const param) };
    if rc == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
}

/// Ends the process immediately, without destructors, exit handlers or flushing, which a blocked thread could delay.
pub fn exit_now(code: u8) -> ! {
    // SAFETY: `_exit` takes any number, touches no memory of ours and does not return.
    unsafe { libc::_exit(i32::from(code)) }
}

/// Allows writes to the terminal from a background process: with `stty tostop` the kernel would stop the process for
/// them.
pub fn ignore_background_writes() {
    // SAFETY: SIG_IGN is a valid disposition for SIGTTOU, and no handler of ours is involved.
    unsafe {
        libc::signal(libc::SIGTTOU, libc::SIG_IGN);
    }
}

/// Page faults (minor, major) and involuntary context switches of the calling thread so far.
pub fn thread_faults() -> (u64, u64, u64) {
    let mut u = std::mem::MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: the pointer is to writable memory of the right size, and the kernel fills it completely on success; on
    // failure `u` keeps its zeros, and all-zero is a valid rusage.
    let u = unsafe {
        libc::getrusage(libc::RUSAGE_THREAD, u.as_mut_ptr());
        u.assume_init()
    };
    let n = |v: libc::c_long| u64::try_from(v).unwrap_or(0);
    (n(u.ru_minflt), n(u.ru_majflt), n(u.ru_nivcsw))
}
