"""An RTDE client in plain Python, written from the protocol's description, that behaves as Universal Robots' own Python client and the
handshake of its C++ library do: both words of refusal raise, the version is negotiated, S, P, S at the start, data drained to the newest.
"""

import socket
import struct
import sys

SIZES = {"BOOL": "?", "UINT8": "B", "UINT32": "I", "INT32": "i", "UINT64": "Q", "DOUBLE": "d", "VECTOR3D": "3d",
         "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I"}


class Client:
    def __init__(self, address, port=30004):
        self.socket = socket.create_connection((address, port), timeout=5)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.buffer = b""

    def send(self, kind, body=b""):
        self.socket.sendall(struct.pack(">HB", len(body) + 3, ord(kind)) + body)

    def package(self):
        while True:
            if len(self.buffer) >= 3:
                size, kind = struct.unpack_from(">HB", self.buffer)
                if len(self.buffer) >= size:
                    body, self.buffer = self.buffer[3:size], self.buffer[size:]
                    return chr(kind), body
            more = self.socket.recv(65536)
            if not more:
                raise ConnectionError("closed by the controller")
            self.buffer += more

    def ask(self, kind, body=b""):
        self.send(kind, body)
        while True:
            got, answer = self.package()
            if got == kind:
                return answer
            if got != "U":  # data in flight is normal
                raise ValueError(f"asked {kind}, got {got} {answer!r}")

    def setup(self, kind, names, frequency=None):
        head = b"" if frequency is None else struct.pack(">d", frequency)
        answer = self.ask(kind, head + ",".join(names).encode())
        types = answer[1:].decode().split(",")
        for name, word in zip(names, types):
            if word in ("NOT_FOUND", "IN_USE"):
                raise LookupError(f"{name}: {word}")
        return answer[0], ">" + "".join(SIZES[t] for t in types)


def main(address):
    client = Client(address)
    assert client.ask("V", struct.pack(">H", 2)) == b"\x01"
    major, minor, _, _ = struct.unpack(">4I", client.ask("v"))
    assert (major, minor) >= (5, 4), (major, minor)
    names = ["timestamp", "actual_q", "actual_qd", "target_q", "robot_mode", "safety_status_bits", "runtime_state",
             "joint_mode", "payload_cog", "output_int_register_24", "output_bit_register_64", "tool_output_mode",
             "actual_digital_output_bits", "input_int_register_24", "input_double_register_24"]
    recipe, layout = client.setup("O", names, 125.0)
    try:
        client.setup("I", ["input_int_register_24", "no_such_input"])
        raise AssertionError("an unknown name was accepted")
    except LookupError as refused:
        assert "no_such_input: NOT_FOUND" in str(refused)
    inputs, input_layout = client.setup("I", ["input_int_register_24", "input_double_register_24"])
    for kind in "SPS":
        assert client.ask(kind) == b"\x01"

    def data():
        while True:
            kind, body = client.package()
            if kind == "U":
                assert body[0] == recipe and len(body) == 1 + struct.calcsize(layout)
                return struct.unpack(layout, body[1:])

    times = [data()[0] for _ in range(126)]
    span = times[-1] - times[0]
    assert all(b > a for a, b in zip(times, times[1:])), "the clock went back"
    # 125 packages at 125 Hz; twice the rate would be half of it. A host that stalls makes it longer, never shorter.
    assert span > 0.9, span
    client.send("U", bytes([inputs]) + struct.pack(input_layout, 4711, -1.25))
    assert any(data()[-2:] == (4711, -1.25) for _ in range(50)), "what was written is not read back"
    other = Client(address)
    assert other.ask("V", struct.pack(">H", 2)) == b"\x01"
    try:
        other.setup("I", ["input_int_register_24"])
        raise AssertionError("an input has two owners")
    except LookupError as refused:
        assert "IN_USE" in str(refused)
    client.socket.close()
    for _ in range(100):
        try:
            other.setup("I", ["input_int_register_24"])
            break
        except LookupError:
            pass
    else:
        raise AssertionError("the input is still held after its owner has gone")
    # Everything that UR's library tests ask for at once.
    rows = [f"{d}_{k}_register_{i}" for d in ("input", "output") for k in ("int", "double") for i in range(48)]
    rows += [f"{d}_bit_register_{i}" for d in ("input", "output") for i in range(64, 128)]
    other.setup("O", rows, 500.0)
    print("plain client: all well")


main(sys.argv[1])
