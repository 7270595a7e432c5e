"""SDU's ur_rtde 1.6.5, unmodified, against a mock controller at the address given. Prints one line a check; exit code 1 if any failed.

The control interface uploads its own 42 kB script to the controller: there is no special case for it in the mock.
"""

import math
import sys
import time

import rtde_control
import rtde_io
import rtde_receive

ADDRESS = sys.argv[1]
FAILED = []


def check(name, ok, detail=""):
    print(f"{'ok  ' if ok else 'FAIL'} {name} {detail}", flush=True)
    if not ok:
        FAILED.append(name)


def near(a, b, tolerance):
    return all(math.isfinite(x) and abs(x - y) <= tolerance for x, y in zip(a, b))


def until(seconds, condition):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.01)
    return condition()


def stream(control, seconds, act):
    """Calls `act` every control step, as the client's examples do."""
    for _ in range(int(seconds / 0.002)):
        start = control.initPeriod()
        act()
        control.waitPeriod(start)


def receiving(receive):
    first = receive.getTimestamp()
    check("receive: the clock runs", until(2, lambda: receive.getTimestamp() > first + 0.1))
    check("receive: running and normal", receive.getRobotMode() == 7 and receive.getSafetyMode() == 1)
    check("receive: joints are numbers", len(receive.getActualQ()) == 6 and near(receive.getActualQ(), receive.getTargetQ(), 1e-3))
    check("receive: temperatures are sane", all(10 < t < 80 for t in receive.getJointTemperatures()))
    check("receive: status bits", receive.getSafetyStatusBits() == 1 and receive.getRobotStatus() & 1 == 1)


def signals(receive):
    io = rtde_io.RTDEIOInterface(ADDRESS)
    io.setStandardDigitalOut(3, True)
    check("io: output 3 on", until(2, lambda: receive.getDigitalOutState(3)))
    io.setStandardDigitalOut(3, False)
    check("io: output 3 off", until(2, lambda: not receive.getDigitalOutState(3)))
    io.setToolDigitalOut(1, True)
    check("io: tool output 1 on", until(2, lambda: receive.getActualDigitalOutputBits() >> 17 & 1 == 1))
    io.setSpeedSlider(0.5)
    check("io: slider", until(2, lambda: abs(receive.getTargetSpeedFraction() - 0.5) < 1e-6))
    io.setSpeedSlider(1.0)
    check("io: slider back", until(2, lambda: abs(receive.getSpeedScaling() - 1.0) < 1e-6))
    io.setInputIntRegister(19, 1234)
    io.setInputDoubleRegister(19, -2.5)
    io.disconnect()


def moves(control, receive):
    q = receive.getActualQ()
    goal = [q[0] + 0.2, q[1] - 0.1, q[2] + 0.1, q[3], q[4], q[5] + 0.3]
    check("moveJ arrives", control.moveJ(goal, 1.05, 1.4) and until(1, lambda: near(receive.getActualQ(), goal, 1e-3)))
    pose = receive.getActualTCPPose()
    pose[2] -= 0.05
    arrived = control.moveL(pose, 0.25, 1.2)
    check("moveL arrives", arrived and until(1, lambda: near(receive.getActualTCPPose(), pose, 1e-3)))
    solved = control.getInverseKinematics(receive.getActualTCPPose())
    check("inverse kinematics", near(solved, receive.getActualQ(), 2e-3), str(solved))
    forward = control.getForwardKinematics()
    check("forward kinematics", near(forward, receive.getActualTCPPose(), 2e-3), str(forward))
    control.moveJ([goal[0] - 1.0] + goal[1:], 1.05, 1.4, True)
    check("moveJ asynchronous sets off", until(2, lambda: abs(receive.getActualQd()[0]) > 0.3))
    control.stopJ(4.0)
    check("stopJ stops", until(1, lambda: near(receive.getActualQd(), [0] * 6, 1e-3)))


def forces(control, receive):
    control.zeroFtSensor()
    before = receive.getActualTCPPose()
    wrench, limits = [0, 0, -10, 0, 0, 0], [0.1, 0.1, 0.05, 0.2, 0.2, 0.2]
    stream(control, 0.6, lambda: control.forceMode([0] * 6, [0, 0, 1, 0, 0, 0], wrench, 2, limits))
    control.forceModeStop()
    dz = receive.getActualTCPPose()[2] - before[2]
    check("forceMode moves the free arm at its limit", -0.06 < dz < -0.01, str(dz))
    check("forceModeStop stops", until(1, lambda: near(receive.getActualQd(), [0] * 6, 1e-3)))
    waypoint = control.getTargetWaypoint()
    check("getTargetWaypoint", len(waypoint) == 6 and all(map(math.isfinite, waypoint)), str(waypoint))
    check("the script still runs", control.isProgramRunning())


def streams(control, receive):
    stream(control, 0.6, lambda: control.speedJ([0.2, 0, 0, 0, 0, -0.1], 1.0, 0.002))
    qd = receive.getActualQd()
    check("speedJ keeps speed", near(qd, [0.2, 0, 0, 0, 0, -0.1], 0.02), str(qd))
    control.speedStop()
    check("speedStop", until(1, lambda: near(receive.getActualQd(), [0] * 6, 1e-3)))
    stream(control, 0.6, lambda: control.speedL([0, 0, 0.05, 0, 0, 0], 0.5, 0.002))
    v = receive.getActualTCPSpeed()
    check("speedL keeps the tool's speed", near(v, [0, 0, 0.05, 0, 0, 0], 0.01), str(v))
    control.speedStop()
    q = receive.getActualQ()
    goal = list(q)

    def servo():
        goal[5] += 0.0003
        control.servoJ(goal, 0.5, 0.5, 0.002, 0.1, 300)

    stream(control, 0.8, servo)
    check("servoJ follows", until(1, lambda: near(receive.getActualQ(), goal, 5e-3)), str(goal[5] - receive.getActualQ()[5]))
    control.servoStop()


def watchdog_and_reconnect(control, receive):
    check("watchdog is set", control.setWatchdog(10))
    for _ in range(20):
        control.kickWatchdog()
        time.sleep(0.02)
    check("a fed watchdog lets the program run", control.isProgramRunning())
    check("a starved watchdog stops it", until(2, lambda: not control.isProgramRunning()))
    check("upload again", control.reuploadScript() and until(2, control.isProgramRunning))
    control.disconnect()
    check("disconnected", not control.isConnected())
    check("reconnected", control.reconnect() and control.isConnected())
    check("reuploaded", control.reuploadScript() and until(2, control.isProgramRunning))
    q = receive.getActualQ()
    q[0] += 0.1
    check("moves after the reconnect", control.moveJ(q, 1.05, 1.4) and until(1, lambda: near(receive.getActualQ(), q, 1e-3)))
    control.stopScript()
    check("the script ends", until(2, lambda: receive.getRobotStatus() & 2 == 0))


def main():
    receive = rtde_receive.RTDEReceiveInterface(ADDRESS)
    receiving(receive)
    signals(receive)
    control = rtde_control.RTDEControlInterface(ADDRESS)
    check("control: its script runs", control.isProgramRunning())
    moves(control, receive)
    forces(control, receive)
    streams(control, receive)
    watchdog_and_reconnect(control, receive)
    control.disconnect()
    receive.disconnect()
    print(f"{len(FAILED)} failed", flush=True)
    sys.exit(1 if FAILED else 0)


main()
