#!/usr/bin/env python3
"""Publishes stereo pairs to graspd from Python: a camera driver to start from. Needs: pip install iceoryx2==0.10.0.

Layout, quality of service and rules are those of shm/LAYOUT.md. The images are a moving ramp; replace `image()`.
"""

import argparse
import ctypes
import os
import sys
import time

import iceoryx2 as iox2


class StereoHeader(ctypes.Structure):
    """User header of a sample: 192 bytes, natural alignment."""

    _fields_ = [
        ("magic", ctypes.c_uint64),
        ("layout_version", ctypes.c_uint32),
        ("header_size", ctypes.c_uint32),
        ("sequence", ctypes.c_uint64),
        ("trigger", ctypes.c_uint64),
        ("capture_ns", ctypes.c_uint64 * 2),
        ("publish_ns", ctypes.c_uint64),
        ("exposure_ns", ctypes.c_uint64),
        ("gain_db", ctypes.c_double),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("stride", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("offset", ctypes.c_uint64 * 2),
        ("size", ctypes.c_uint64 * 2),
        ("clock_source", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("camera_id", ctypes.c_uint64 * 2),
        ("calibration_id", ctypes.c_uint64),
        ("dropped", ctypes.c_uint64),
        ("sequence_end", ctypes.c_uint64),
        ("reserved", ctypes.c_uint64 * 3),
    ]

    @staticmethod
    def type_name() -> str:
        return "graspd_StereoHeader_v1"


MAGIC = int.from_bytes(b"GRASPDST", "little")
assert ctypes.sizeof(StereoHeader) == 192


def id_hash(text: str) -> int:
    """FNV-1a, 64 bits: a camera's serial number as a header field."""
    h = 0xCBF29CE484222325
    for b in text.encode():
        h = ((h ^ b) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return h or 1


def default_root() -> str:
    d = os.environ.get("XDG_RUNTIME_DIR", "")
    return os.path.join(d, "graspd") if os.path.isdir(d) else f"/tmp/graspd-{os.geteuid()}"


def image(width: int, height: int, k: int, view: int) -> bytes:
    """One mono8 image: a diagonal ramp that moves with k. A real driver copies its camera's buffer here."""
    row = bytes((x + 3 * k + 50 * view) & 0xFF for x in range(width + height))
    return b"".join(row[y : y + width] for y in range(height))


def raw(path, n):
    """Reads an image from a file of exactly n bytes."""
    with open(path, "rb") as f:
        data = f.read()
    if len(data) != n:
        sys.exit(f"{path}: {len(data)} bytes, expected {n}: width x height of mono8")
    return data


def main() -> int:
    a = argparse.ArgumentParser(description=__doc__)
    a.add_argument("--root", default=default_root(), help="shared-memory root folder: shm.root of graspd.toml")
    a.add_argument("--prefix", default=f"graspd{os.geteuid()}_", help="prefix of names in /dev/shm; graspd uses the default")
    a.add_argument("--cell", default="cell", help="cell of graspd.toml")
    a.add_argument("--width", type=int, default=1280)
    a.add_argument("--height", type=int, default=1024)
    a.add_argument("--rate", type=float, default=60.0, help="pairs per second")
    a.add_argument("--count", type=int, default=0, help="stop after so many pairs; 0 never")
    a.add_argument("--drop-every", type=int, default=0, help="drop every n-th pair, as a test of the reader")
    a.add_argument("--left-raw", help="publish this file of width x height bytes instead of a test image")
    a.add_argument("--right-raw", help="the same for the right image")
    a.add_argument("--serial-left", default="left")
    a.add_argument("--serial-right", default="right")
    o = a.parse_args()

    iox2.set_log_level(iox2.LogLevel.Fatal)
    os.makedirs(o.root, mode=0o700, exist_ok=True)
    # The configuration is set here, not read from a file, so that nothing is shared with other iceoryx2 users of the machine.
    config = iox2.config.default()
    config.global_cfg.root_path = iox2.Path.new(o.root)
    config.global_cfg.prefix = iox2.FileName.new(o.prefix)
    node = (
        iox2.NodeBuilder.new()
        .config(config)
        .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        .create(iox2.ServiceType.Ipc)
    )
    service = (
        node.service_builder(iox2.ServiceName.new(f"{o.cell}/frames/stereo"))
        .publish_subscribe(iox2.Slice[ctypes.c_uint8])
        .user_header(StereoHeader)
        .history_size(0)
        .subscriber_max_buffer_size(2)
        .subscriber_max_borrowed_samples(2)
        .max_publishers(2)
        .max_subscribers(4)
        .max_nodes(16)
        .enable_safe_overflow(True)
        .open_or_create()
    )
    n = o.width * o.height
    publisher = (
        service.publisher_builder()
        .initial_max_slice_len(2 * n)
        .max_loaned_samples(1)
        .allocation_strategy(iox2.AllocationStrategy.Static)
        .create()
    )
    if o.left_raw and o.right_raw:
        images = [[raw(o.left_raw, n), raw(o.right_raw, n)]] * 8
    else:
        images = [[image(o.width, o.height, k, view) for view in (0, 1)] for k in range(8)]
    period = 1e9 / o.rate
    start = time.monotonic_ns()
    print('{"ready":true}', flush=True)
    sequence = dropped = 0
    while o.count == 0 or sequence < o.count:
        due = start + (sequence + 1) * period
        time.sleep(max(0.0, (due - time.monotonic_ns()) * 1e-9))
        capture = time.monotonic_ns()  # a real driver: the camera's own stamp, mapped to CLOCK_MONOTONIC
        sequence += 1
        if o.drop_every and sequence % o.drop_every == 0:
            dropped += 1
            continue
        sample = publisher.loan_slice_uninit(2 * n)
        target = sample.payload().as_ptr()
        for view in (0, 1):
            ctypes.memmove(target + view * n, images[sequence % 8][view], n)
        h = sample.user_header().contents
        h.magic, h.layout_version, h.header_size = MAGIC, 1, 192
        h.sequence, h.trigger = sequence, sequence
        h.capture_ns[0] = h.capture_ns[1] = capture
        h.exposure_ns, h.gain_db = 2_000_000, 0.0
        h.width, h.height, h.stride, h.pixel_format = o.width, o.height, o.width, 1
        h.offset[0], h.offset[1] = 0, n
        h.size[0] = h.size[1] = n
        h.clock_source, h.flags = 1, 0
        h.camera_id[0], h.camera_id[1] = id_hash(o.serial_left), id_hash(o.serial_right)
        h.calibration_id, h.dropped = 0, dropped
        for i in range(3):
            h.reserved[i] = 0
        h.publish_ns = time.monotonic_ns()
        h.sequence_end = sequence
        sample.assume_init().send()
    return 0


if __name__ == "__main__":
    sys.exit(main())
