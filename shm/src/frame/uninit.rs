//! The only `unsafe` of this crate: a loaned payload declared initialised without clearing it.

use super::StereoHeader;
use iceoryx2::prelude::ipc;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use std::mem::MaybeUninit;

/// A loaned sample, ready to be filled in place.
pub(super) type Loaned = SampleMut<ipc::Service, [u8], StereoHeader>;

/// Declares a fresh loan initialised, which saves writing 2.6 MB of zeros that the caller overwrites anyway.
pub(super) fn assume_bytes(loan: SampleMutUninit<ipc::Service, [MaybeUninit<u8>], StereoHeader>) -> Loaned {
    // SAFETY: the payload is in a shared-memory object made with ftruncate and mmap: the kernel hands it out zeroed,
    // and since then only the bytes of earlier samples were written to it. So every byte is initialised memory, and
    // every bit pattern is a valid `u8`. iceoryx2 wrote the user header with `Default` when it loaned the sample.
    unsafe { loan.assume_init() }
}
