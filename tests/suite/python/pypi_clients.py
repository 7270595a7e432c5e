"""Clients from PyPI, unmodified, against a mock controller at the address given. Prints one line a check; exit code 1 if any failed.

Universal Robots does not publish its Python RTDE client on PyPI, but two packages carry its files: URsocket 0.2 the first edition (with
its copyright notice), urpy 1.2.0 a later one with protocol fall-back and buffered receiving. Beside them: ur_remote 0.1.3 (dashboard
and primary interface) and ur_aj 0.1.5 (bare script lines, real-time interface).
"""

import importlib
import importlib.util
import math
import os
import sys
import time

ADDRESS = sys.argv[1]
FAILED = []


def check(name, ok, detail=""):
    print(f"{'ok  ' if ok else 'FAIL'} {name} {detail}", flush=True)
    if not ok:
        FAILED.append(name)


def until(seconds, condition):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.01)
    return condition()


# Names and types as Universal Robots' examples configure them.
STATE = [("target_q", "VECTOR6D"), ("actual_q", "VECTOR6D"), ("timestamp", "DOUBLE"), ("robot_mode", "INT32"),
         ("joint_mode", "VECTOR6INT32"), ("payload_cog", "VECTOR3D"), ("actual_digital_output_bits", "UINT64"),
         ("runtime_state", "UINT32"), ("tool_output_mode", "UINT8"), ("output_bit_register_64", "BOOL"),
         ("input_int_register_30", "INT32"), ("input_double_register_30", "DOUBLE")]
SETPOINT = [("input_double_register_30", "DOUBLE"), ("input_int_register_30", "INT32"), ("input_bit_registers0_to_31", "UINT32")]


def rtde_session(label, rtde, registers_free=True):
    """As in Universal Robots' examples record.py and example_control_loop.py."""
    con = rtde.RTDE(ADDRESS, 30004)
    con.connect()
    check(f"{label}: connected", con.is_connected())
    version = con.get_controller_version()
    check(f"{label}: controller version", version[:2] == (5, 11), str(version))
    names, types = [n for n, _ in STATE], [t for _, t in STATE]
    check(f"{label}: outputs with types", con.send_output_setup(names, types, frequency=500) is True)
    check(f"{label}: a wrong type is noticed", con.send_output_setup(["timestamp"], ["INT32"]) is False)
    con.send_output_setup(names, types, frequency=500)
    setpoint = con.send_input_setup([n for n, _ in SETPOINT], [t for _, t in SETPOINT])
    check(f"{label}: inputs with types", setpoint is not None)
    for names_of, call in (("output", con.send_output_setup), ("input", con.send_input_setup)):
        try:
            call(["no_such_variable"])
            check(f"{label}: an unknown {names_of} raises", False)
        except ValueError as e:
            check(f"{label}: an unknown {names_of} raises", "NOT_FOUND" in str(e), str(e))
    con.send_output_setup(names, types, frequency=500)
    check(f"{label}: started", bool(con.send_start()))
    state = con.receive()
    check(f"{label}: a state", len(state.actual_q) == 6 and all(map(math.isfinite, state.actual_q)) and state.robot_mode == 7)
    check(f"{label}: joint modes", list(state.joint_mode) == [253] * 6)
    first = state.timestamp
    check(f"{label}: the clock runs", until(5, lambda: con.receive().timestamp > first + 0.2))
    setpoint.input_double_register_30 = -1.25
    setpoint.input_int_register_30 = 4711
    setpoint.input_bit_registers0_to_31 = 5
    con.send(setpoint)

    def written():
        s = con.receive()
        return s.input_int_register_30 == 4711 and s.input_double_register_30 == -1.25

    check(f"{label}: what it writes is read back", until(5, written))
    other = rtde.RTDE(ADDRESS, 30004)
    other.connect()
    try:
        other.send_input_setup(["input_int_register_30"], ["INT32"])
        check(f"{label}: a second owner is refused", False)
    except ValueError as e:
        check(f"{label}: a second owner is refused", "in use" in str(e), str(e))
    other.disconnect()
    check(f"{label}: paused", bool(con.send_pause()))
    check(f"{label}: started again", bool(con.send_start()) and con.receive() is not None)
    if hasattr(con, "receive_buffered"):
        check(f"{label}: buffered", until(5, lambda: con.receive_buffered() is not None))
    con.disconnect()
    # Once the first is gone its inputs are free.
    again = rtde.RTDE(ADDRESS, 30004)
    again.connect()

    def free():
        try:
            return again.send_input_setup(["input_int_register_30"], ["INT32"]) is not None
        except ValueError:
            return False

    check(f"{label}: reconnected, inputs free", until(5, free))
    again.disconnect()


def first_edition():
    folder = os.path.dirname(importlib.util.find_spec("URsocket").origin)
    sys.path.insert(0, folder)
    try:
        rtde_session("URsocket", importlib.import_module("rtde"))
    finally:
        sys.path.remove(folder)
        for name in ("rtde", "serialize", "rtde_config"):
            sys.modules.pop(name, None)


def later_edition():
    rtde_session("urpy", importlib.import_module("urpy.rtde.rtde"))


def dashboard():
    from ur_remote import URRobot
    from ur_remote.Dashboard import Dashboard, RobotMode

    robot = URRobot.URRobot(ADDRESS) if hasattr(URRobot, "URRobot") else URRobot(ADDRESS)
    d = robot.Dashboard
    check("ur_remote: running", d.getRobotMode() == RobotMode.RUNNING)
    check("ur_remote: version", d.getPolyscopeVersion().startswith("URSoftware 5.11"))
    check("ur_remote: model and number", d.getRobotModel() == "UR5" and d.getSerialNumber().startswith("20"))
    check("ur_remote: safety", d.getSafetyStatus() == "Safetystatus: NORMAL", d.getSafetyStatus())
    check("ur_remote: nothing loaded", d.getLoadedProgram() == "No program loaded" and not d.isRunning())
    check("ur_remote: popup", d.popupDisplay("hello") == "showing popup" and d.popupClose() == "closing popup")
    check("ur_remote: log", d.addToLog("note") == "Added log message")
    robot.powerOff()
    check("ur_remote: off", d.getRobotMode() == RobotMode.POWER_OFF)
    robot.powerOn()
    check("ur_remote: on again", d.getRobotMode() == RobotMode.RUNNING)
    for _ in range(5):
        robot.Primary.readPort()
    check("ur_remote: primary interface is read", True)
    check("ur_remote: quit", d.quit() == "Disconnected")
    second = Dashboard(ADDRESS)
    check("ur_remote: connects again", second.connect().startswith("Connected: Universal Robots Dashboard Server"))


def script_lines():
    core = importlib.import_module("ur_aj.core")
    core.configure_robot(ADDRESS)
    before = core.getpose()
    core.moveLoffset(0, 0, -30)
    # Its own wait looks at the tool's speed, which is zero until the move has begun.
    moved = until(10, lambda: abs(abs(core.getpose()[2] - before[2]) + abs(core.getpose()[0] - before[0])) > 5)
    core.wait_until_stopped()
    after = core.getpose()
    gone = math.dist(before[:3], after[:3])
    check("ur_aj: moves by an offset", moved and abs(gone - 30) < 0.5, f"{gone:.2f} mm")
    check("ur_aj: joints in degrees", all(math.isfinite(q) for q in core.getjoints()))


def main():
    for part in (first_edition, later_edition, dashboard, script_lines):
        try:
            part()
        except Exception as e:  # the others are run all the same
            check(f"{part.__name__}: {type(e).__name__}", False, str(e))
    print(f"{len(FAILED)} failed", flush=True)
    sys.exit(1 if FAILED else 0)


main()
