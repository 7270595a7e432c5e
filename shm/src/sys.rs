//! The crate's only `unsafe`.

use crate::frame::StereoHeader;
use iceoryx2::prelude::ipc;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use std::mem::MaybeUninit;

/// A loaned sample, ready to be filled in place.
pub(crate) type Loaned = SampleMut<ipc::Service, [u8], StereoHeader>;

/// Declares a fresh loan initialised without writing 2.6 MB of zeros that the caller overwrites anyway.
pub(crate) fn assume_bytes(loan: SampleMutUninit<ipc::Service, [MaybeUninit<u8>], StereoHeader>) -> Loaned {
    // SAFETY: the payload lies in a shared-memory object obtained by ftruncate and mmap: the kernel gives it zeroed, and only
    // bytes of former samples were written to it since. Every byte is thus initialised memory, and every bit pattern is a `u8`.
    // (The user header was written by iceoryx2 with `Default` when the sample was loaned.)
    unsafe { loan.assume_init() }
}
