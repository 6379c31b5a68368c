#!/usr/bin/env python3
"""Checks the simulated UR5 controller with a client that was written elsewhere: the ur-rtde library from PyPI.

Usage: check.py SIMULATOR [CHECK]

SIMULATOR is the simulator binary; each check starts a controller of its own on 127.83.x.y. It needs the package ur-rtde, see
scripts/check-ur-rtde. It prints one line for each check; the exit code is 0 if all hold, and 1 otherwise. With CHECK only that one runs.

Every check has a process of its own, because ur-rtde 1.6.5 sometimes crashes when a call meets its own reconnecting thread;
a check whose process was killed by a signal is repeated.
"""

import math
import os
import socket
import subprocess
import sys
import threading
import time
import traceback

import dashboard_client
import rtde_control
import rtde_io
import rtde_receive

SIMULATOR = sys.argv[1]
FLAG_UPPER = rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
FLAG_UPLOAD = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
START_Q = [math.radians(d) for d in (0, -90, 90, -90, -90, 0)]


class Robot:
    """A simulated controller in a process of its own, and the faults of its operator port."""

    def __init__(self, series):
        pid = os.getpid()
        self.host = f"127.83.{1 + pid // 250 % 250}.{1 + pid % 250}"
        command = [SIMULATOR, "ur", "--address", self.host, "--series", series, "--seconds", "100"]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        self.process.stdout.readline()
        self.log = []
        threading.Thread(target=lambda: self.log.extend(iter(self.process.stdout.readline, "")), daemon=True).start()

    def started(self):
        """How many programs have started so far."""
        return sum("program rtde_control started" in line for line in self.log)

    def fault(self, text):
        with socket.create_connection((self.host, 29995), 5) as s:
            s.sendall((text + "\n").encode())
            answer = s.makefile().readline().strip()
        assert answer == "ok", answer

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()

    def receive(self, upper=False):
        return rtde_receive.RTDEReceiveInterface(self.host, -1.0, [], False, upper)

    def control(self, upper=False):
        return rtde_control.RTDEControlInterface(self.host, -1.0, FLAG_UPLOAD | (FLAG_UPPER if upper else 0))


def until(what, condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"never: {what}"
        time.sleep(0.01)


def raises(kind, text, action):
    try:
        action()
    except kind as error:
        assert text in str(error), f"raised '{error}', not '{text}'"
        return
    raise AssertionError(f"did not raise '{text}'")


def stream(control, start, seconds, amplitude=0.3):
    """Moves wrist 3 out and back by servoJ at 30 Hz. Gives whether every call was accepted, and where wrist 3 was sent last."""
    ticks = int(seconds * 30)
    accepted = True
    begin = time.monotonic()
    q = list(start)
    for i in range(ticks):
        q[5] = start[5] + amplitude * (1 - math.cos((i + 1) / ticks * 2 * math.pi)) / 2
        accepted = control.servoJ(q, 0, 0, 1 / 30, 0.1, 300) and accepted
        time.sleep(max(0.0, begin + (i + 1) / 30 - time.monotonic()))
    return accepted, q[5]


def receive(series, upper):
    with Robot(series) as robot:
        r = robot.receive(upper)
        assert all(abs(a - b) < 1e-9 for a, b in zip(r.getActualQ(), START_Q)), r.getActualQ()
        assert (r.getRobotMode(), r.getSafetyMode(), r.getRuntimeState()) == (7, 1, 1)
        before = r.getTimestamp()
        until("time passes", lambda: r.getTimestamp() > before + 0.5)
        assert abs(math.dist(r.getActualTCPPose()[:3], (0, 0, 0))) > 0.1
        assert r.isConnected()
        r.disconnect()


def control(series, upper):
    with Robot(series) as robot:
        r = robot.receive(upper)
        c = robot.control(upper)
        assert c.isProgramRunning()
        accepted, _ = stream(c, START_Q, 2.0)
        assert accepted, "servoJ refused"
        until("arrived", lambda: abs(r.getActualQ()[5]) < 1e-3)
        assert c.servoStop(10.0)
        assert c.moveJ([q + 0.1 for q in START_Q], 1.0, 1.0), "moveJ"
        assert all(abs(a - b - 0.1) < 1e-3 for a, b in zip(r.getActualQ(), START_Q))
        assert c.speedJ([0, 0, 0, 0, 0, 0.2], 1.0)
        until("speed", lambda: abs(r.getActualQd()[5] - 0.2) < 1e-3)
        assert c.speedStop(10.0)
        until("rest", lambda: abs(r.getActualQd()[5]) < 1e-3)
        c.stopScript()
        until("stopped", lambda: r.getRuntimeState() == 1)
        c.disconnect()


def watchdog(series, upper):
    with Robot(series) as robot:
        r = robot.receive(upper)
        c = robot.control(upper)
        assert c.setWatchdog(10.0)
        for _ in range(20):
            assert c.kickWatchdog()
            time.sleep(0.03)
        assert c.isProgramRunning()
        until("lapsed", lambda: r.getRuntimeState() == 1)
        until("servoJ refused", lambda: not c.servoJ(START_Q, 0, 0, 1 / 30, 0.1, 300))
        assert c.reuploadScript()
        until("running again", lambda: r.getRuntimeState() == 2)
        # The client may still wait for the program's first sign.
        until("servoJ taken again", lambda: c.servoJ(START_Q, 0, 0, 1 / 30, 0.1, 300))
        c.disconnect()


def io(series, upper):
    with Robot(series) as robot:
        r = robot.receive(upper)
        i = rtde_io.RTDEIOInterface(robot.host, False, upper)
        assert i.setSpeedSlider(0.5)
        until("slider", lambda: r.getTargetSpeedFraction() == 0.5)
        assert i.setStandardDigitalOut(2, True)
        until("output on", lambda: r.getActualDigitalOutputBits() == 4)
        assert i.setStandardDigitalOut(2, False)
        until("output off", lambda: r.getActualDigitalOutputBits() == 0)
        assert i.setAnalogOutputVoltage(0, 0.25)
        until("analogue output", lambda: abs(r.getStandardAnalogOutput0() - 0.25) < 1e-9)
        assert i.setInputIntRegister(20 + (24 if upper else 0), 5)
        assert i.setInputDoubleRegister(20 + (24 if upper else 0), 2.5)
        i.disconnect()


def dashboard(series, _upper):
    with Robot(series) as robot:
        d = dashboard_client.DashboardClient(robot.host)
        d.connect()
        assert d.isConnected()
        assert "RUNNING" in d.robotmode() and "NORMAL" in d.safetymode()
        assert d.polyscopeVersion().startswith("3.15." if series == "cb3" else "5.11."), d.polyscopeVersion()
        assert not d.running()
        d.popup("hello")
        d.closePopup()
        d.closeSafetyPopup()
        c = robot.control()
        until("running", d.running)
        assert "rtde_control" in d.programState()
        d.pause()
        until("paused", lambda: "PAUSED" in d.programState())
        d.play()
        until("running", d.running)
        d.stop()
        until("stopped", lambda: not d.running())
        c.disconnect()
        d.powerOff()
        until("off", lambda: "POWER_OFF" in d.robotmode())
        d.powerOn()
        until("idle", lambda: "IDLE" in d.robotmode())
        d.brakeRelease()
        until("ready", lambda: "RUNNING" in d.robotmode())
        robot.fault("protective-stop")
        assert "PROTECTIVE_STOP" in d.safetymode()
        time.sleep(5.1)
        d.unlockProtectiveStop()
        assert "NORMAL" in d.safetymode()
        d.disconnect()


def fault_not_found():
    with Robot("cb3") as robot:
        robot.fault("not-found=actual_qd")
        raises(RuntimeError, "actual_qd", robot.receive)


def fault_in_use():
    with Robot("cb3") as robot:
        robot.fault("in-use=input_double_register_3")
        raises(RuntimeError, "already in use", robot.control)


def fault_refuse_version_2():
    # ur_rtde ignores the refusal and sets up as version 2; the controller reads that as version 1.
    with Robot("cb3") as robot:
        robot.fault("refuse-version-2")
        try:
            r = robot.receive()
            assert r.getTimestamp() == 0.0, "data in spite of the refusal"
        except RuntimeError:
            pass


def fault_text_on_connect():
    with Robot("cb3") as robot:
        robot.fault("text-on-connect=SafetySetup has not been confirmed yet")
        r = robot.receive()
        before = r.getTimestamp()
        until("streams by luck", lambda: r.getTimestamp() > before)
        r.disconnect()


def fault_fin_while_receiving():
    with Robot("cb3") as robot:
        r = robot.receive()
        before = r.getTimestamp()
        until("data", lambda: r.getTimestamp() > before)
        robot.fault("fin")
        until("disconnected", lambda: not r.isConnected())
        last = r.getTimestamp()
        time.sleep(0.2)
        assert r.getTimestamp() == last > 0, "getters keep the last value"


def fault_stall():
    with Robot("cb3") as robot:
        r = robot.receive()
        robot.fault("stall=600")
        until("a frozen timestamp", lambda: (r.getTimestamp(), time.sleep(0.1))[0] == r.getTimestamp())
        assert r.isConnected(), "still counts as connected"
        until("given up after 2.5 s", lambda: not r.isConnected())


def fault_fin_to_control():
    with Robot("cb3") as robot:
        c = robot.control()
        until("the program started", lambda: robot.started() == 1)
        robot.fault("fin")
        # ur_rtde reconnects by itself. What it does then is its own affair: it may reconnect over and over, and often crashes.
        until("reconnected and the program sent again", lambda: robot.started() == 2, 20)


def fault_late_start():
    with Robot("cb3") as robot:
        robot.fault("late-start=30")
        raises(RuntimeError, "Failed to start control script", robot.control)


def fault_protective_stop():
    with Robot("cb3") as robot:
        r = robot.receive()
        c = robot.control()
        assert stream(c, START_Q, 0.5)[0]
        robot.fault("protective-stop")
        until("seen", lambda: r.getSafetyStatusBits() == (1 << 2 | 1 << 10) and r.getRuntimeState() == 4)
        assert r.isProtectiveStopped()
        until("servoJ refused", lambda: not c.servoJ(START_Q, 0, 0, 1 / 30, 0.1, 300))


def fault_emergency_stop():
    with Robot("e") as robot:
        r = robot.receive()
        c = robot.control()
        robot.fault("emergency-stop")
        until("seen", lambda: r.getRobotMode() == 3 and r.getSafetyMode() == 7 and r.getRuntimeState() == 1)
        assert r.isEmergencyStopped()
        until("servoJ refused", lambda: not c.servoJ(START_Q, 0, 0, 1 / 30, 0.1, 300))


def fault_jump():
    with Robot("cb3") as robot:
        r = robot.receive()
        c = robot.control()
        q = list(START_Q)
        q[5] += 1.0
        c.servoJ(q, 0, 0, 1 / 30, 0.1, 300)
        until("protective stop", lambda: r.getSafetyMode() == 3)
        assert abs(r.getActualQ()[5]) < 1e-3, "did not move"


def fault_pieces():
    # Packets that are split or joined on their way reach the client whole.
    with Robot("cb3") as robot:
        c = robot.control()
        r = robot.receive()
        for fault in ("split=600", "clear", "coalesce=600"):
            robot.fault(fault)
            before = r.getTimestamp()
            assert stream(c, START_Q, 0.5)[0], fault
            assert r.getTimestamp() > before + 0.3 and abs(r.getActualQ()[0]) < 1e-9, fault
        c.disconnect()


def out_of_range():
    with Robot("cb3") as robot:
        c = robot.control()
        raises(ValueError, "", lambda: c.servoJ(START_Q, 0, 0, 1 / 30, 0.5, 300))
        raises(ValueError, "", lambda: c.servoJ(START_Q, 0, 0, 1 / 30, 0.1, 5000))
        c.disconnect()


CHECKS = {}
for series in ("cb3", "e"):
    for upper in (False, True):
        for part in (receive, control, watchdog, io):
            name = f"{part.__name__}_{series}_{'upper' if upper else 'lower'}"
            CHECKS[name] = lambda part=part, series=series, upper=upper: part(series, upper)
    CHECKS[f"dashboard_{series}"] = lambda series=series: dashboard(series, False)
for part in (
    fault_not_found,
    fault_in_use,
    fault_refuse_version_2,
    fault_text_on_connect,
    fault_fin_while_receiving,
    fault_stall,
    fault_fin_to_control,
    fault_late_start,
    fault_protective_stop,
    fault_emergency_stop,
    fault_jump,
    fault_pieces,
    out_of_range,
):
    CHECKS[part.__name__] = part


def one(name):
    try:
        CHECKS[name]()
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    # This ends the process without waiting for the client library's threads.
    os._exit(0)


def every():
    held = 0
    for name in CHECKS:
        begin = time.monotonic()
        for attempt in range(3):
            done = subprocess.run([sys.executable, __file__, SIMULATOR, name], capture_output=True, text=True, timeout=120)
            if done.returncode >= 0:
                break
            print(f"{name}: ur-rtde crashed (signal {-done.returncode}), repeated", flush=True)
        held += done.returncode == 0
        print(f"{name}: {'holds' if done.returncode == 0 else 'FAILED'} ({time.monotonic() - begin:.1f} s)", flush=True)
        if done.returncode != 0:
            print(done.stdout + done.stderr, flush=True)
    print(f"{held} of {len(CHECKS)} checks hold")
    sys.exit(0 if held == len(CHECKS) else 1)


if len(sys.argv) > 2:
    one(sys.argv[2])
every()
