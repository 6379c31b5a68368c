"""A second robot to check rt-controller against: a small RTDE server that runs the uploaded program, written apart from `simulator`.

It knows RTDE protocol 2, one port for programs, and of URScript what reads like Python once its `end` lines are gone. Its arm follows servoj
with a delay of the lookahead. It looks at everything that the program tells servoj. check.py drives it; it runs in a thread of that process.
"""

import math
import re
import select
import socket
import struct
import threading
import time

SIZES = {"DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I"}
STOPPED, PLAYING, PAUSED = 1, 2, 4
TILT = 5
HZ = 125.0
STANCE = [0.3, -1.2, 1.4, -0.5, 1.6, 0.0]
# The limits of config/sim.toml, degrees, degrees/s and degrees/s^2.
RANGE, RATE, ACCELERATION = (0.0, 110.0), 90.0, 1500.0


def kind(name):
    for part, its in (("int_register", "INT32"), ("double_register", "DOUBLE"), ("_qd", "VECTOR6D"), ("_q", "VECTOR6D"), ("_bits", "UINT32"),
                      ("runtime_state", "UINT32"), ("_mode", "INT32"), ("timestamp", "DOUBLE"), ("fraction", "DOUBLE"),
                      ("speed_scaling", "DOUBLE")):
        if part in name:
            return its
    return "NOT_FOUND"


class Robot:
    def __init__(self, address, log):
        self.address, self.log = address, log
        self.lock = threading.RLock()
        self.ints, self.doubles = {}, {}
        self.out = {"int": {}, "double": {}}
        self.q, self.qd, self.told = list(STANCE), [0.0] * 6, None
        self.past = [list(STANCE)] * 5
        self.runtime, self.program, self.uploads = STOPPED, None, 0
        self.slider, self.scaling, self.limit, self.teach = 1.0, 1.0, 999.0, False
        self.jogs, self.cut_until, self.owed, self.watchdog, self.fed = {}, 0.0, 0.0, None, 0.0
        self.time, self.poured_ml, self.faults, self.targets = 0.0, 0.0, [], []
        self.speeds, self.begun = [], False
        self.clients, self.trace, self.ending = [], [], False
        self.rtde, self.script = self.listen(30004), self.listen(30002)
        threading.Thread(target=self.run, daemon=True).start()

    def listen(self, port):
        s = socket.socket()
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        s.bind((self.address, port))
        s.listen(4)
        return s

    def alpha(self):
        return math.degrees(self.past[0][TILT])

    # ---- the program ----

    def upload(self, text):
        lines = []
        for line in text.splitlines():
            line = line.split("#")[0].rstrip()
            if line.strip() in ("", "end"):
                continue
            line = re.sub(r"^(\s*)(servoj|sync)\(", r"\1yield \2(", line)
            lines.append(re.sub(r"^(\s*)stopj\(", r"\1yield from stopj(", line))
        name = re.match(r"def (\w+)", lines[0]).group(1)
        names = {"get_steptime": lambda: 1 / HZ, "get_target_joint_positions": lambda: list(self.q), "sqrt": math.sqrt,
                 "get_actual_joint_positions": lambda: list(self.past[0]), "get_target_joint_speeds": lambda: list(self.qd),
                 "read_input_integer_register": lambda k: self.ints.get(k, 0), "textmsg": lambda *a: self.log("program: %s" % (a,)),
                 "read_input_float_register": lambda k: self.doubles.get(k, 0.0),
                 "write_output_integer_register": lambda k, v: self.out["int"].__setitem__(k, v),
                 "write_output_float_register": lambda k, v: self.out["double"].__setitem__(k, v),
                 "rtde_set_watchdog": self.set_watchdog, "servoj": self.servoj, "sync": lambda: None, "stopj": self.stopj}
        exec(compile("\n".join(lines) + "\n  yield\n", "program", "exec"), names)
        self.program, self.runtime, self.told, self.speeds, self.begun = names[name](), PLAYING, None, [], True
        self.uploads += 1
        self.log("program started")

    def set_watchdog(self, variable, hz, action):
        assert action == "stop"
        self.watchdog, self.fed = 1.0 / hz, self.time

    def servoj(self, q, a, v, t, lookahead, gain):
        """Looks at one command: all six joints, range, rate and acceleration; it may go on from the last one, or begin anew where the arm is."""
        self.lookahead = lookahead
        ways = [] if self.told is None else [(self.told, s) for s in self.speeds]
        if self.begun or not ways or any(abs(q[i] - self.told[i]) > 1e-9 for i in range(TILT)):
            ways.append((self.q, max(-math.radians(RATE), min(math.radians(RATE), self.qd[TILT]))))
        fits = []
        for before, speed in ways:
            new = (q[TILT] - before[TILT]) * HZ
            others = all(abs(q[i] - before[i]) < 1e-6 for i in range(TILT))
            if others and abs(new) < math.radians(RATE) * 1.000001 and abs(new - speed) < math.radians(ACCELERATION) / HZ * 1.000001:
                fits.append(new)
        if not fits:
            self.faults.append("%.3f s: servoj is told %s after %s" % (self.time, q, self.told))
            fits = [0.0]
        alpha, now = math.degrees(q[TILT]), math.degrees(self.q[TILT])
        if not min(RANGE[0], now) - 0.02 <= alpha <= max(RANGE[1], now) + 0.02:
            self.faults.append("%.3f s: servoj is told %.3f degrees" % (self.time, alpha))
        self.told, self.speeds, self.begun = list(q), fits, False

    def stopj(self, deceleration):
        self.told = None
        while any(abs(v) > 1e-3 for v in self.qd):
            yield

    # ---- the arm, one control cycle ----

    def cycle(self):
        dt = 1 / HZ
        self.time += dt
        share = self.slider * self.scaling
        if self.runtime == PLAYING and self.watchdog and self.time - self.fed > self.watchdog:
            self.log("watchdog")
            self.stop()
        if self.runtime == PLAYING:
            # A slowed robot takes longer for each servoj.
            self.owed += share
            if self.owed >= 1.0 - 1e-9:
                self.owed -= 1.0
                try:
                    next(self.program)
                except StopIteration:
                    self.stop()
        for i in range(6):
            if i in self.jogs:
                step = max(-math.radians(30) * dt, min(math.radians(30) * dt, self.jogs[i]))
                self.jogs[i] -= step
                wanted = step / dt
                if abs(self.jogs[i]) < 1e-9:
                    del self.jogs[i]
            elif self.runtime == PLAYING and self.told is not None:
                wanted = (self.told[i] - self.q[i]) / self.lookahead * share
            else:
                wanted = self.qd[i] - max(-20 * dt, min(20 * dt, self.qd[i]))
            most = math.radians(self.limit)
            self.qd[i] = max(-most, min(most, wanted))
            self.q[i] += self.qd[i] * dt
        self.past = self.past[1:] + [list(self.q)]
        self.poured_ml += min(25.0, max(0.0, self.alpha() - 50.0)) * dt
        self.trace.append((self.time, self.alpha(), math.degrees(self.qd[TILT])))

    def stop(self):
        self.runtime, self.program, self.told, self.watchdog, self.owed = STOPPED, None, None, None, 0.0

    def value(self, name):
        plain = {"timestamp": self.time, "actual_q": self.past[0], "target_q": self.q, "actual_qd": self.qd, "robot_mode": 7,
                 "safety_mode": 1, "safety_status_bits": 1, "runtime_state": self.runtime, "target_speed_fraction": self.slider,
                 "robot_status_bits": 1 | 2 * (self.runtime != STOPPED) | 4 * self.teach, "speed_scaling": self.scaling * self.slider}
        if name in plain:
            return plain[name]
        number = int(name.rsplit("_", 1)[1])
        return self.out["int" if "int" in name else "double"].get(number, 0)

    # ---- sockets ----

    def run(self):
        due = time.monotonic()
        while not self.ending:
            due = max(due + 1 / HZ, time.monotonic() - 0.1)
            with self.lock:
                cut = time.monotonic() < self.cut_until
                if not cut:
                    self.serve()
                self.cycle()
                if not cut:
                    self.publish()
            time.sleep(max(0.0, due - time.monotonic()))

    def serve(self):
        sockets = [self.rtde, self.script] + [c["s"] for c in self.clients]
        for s in select.select(sockets, [], [], 0)[0]:
            if s in (self.rtde, self.script):
                client = s.accept()[0]
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if s is self.rtde:
                    self.targets.append(None)
                self.clients.append({"s": client, "in": b"", "rtde": s is self.rtde, "on": False})
                continue
            client = next(c for c in self.clients if c["s"] is s)
            try:
                data = s.recv(65536)
            except OSError:
                data = b""
            if not data:
                self.clients.remove(client)
                s.close()
                continue
            client["in"] += data
            if not client["rtde"]:
                if re.search(rb"^end\s*$", client["in"], re.M):
                    self.upload(client["in"].decode())
                    client["in"] = b""
                continue
            while len(client["in"]) >= 3 and len(client["in"]) >= (size := struct.unpack(">H", client["in"][:2])[0]) >= 3:
                self.packet(client, client["in"][2:3], client["in"][3:size])
                client["in"] = client["in"][size:]

    def packet(self, client, what, payload):
        def answer(data):
            client["s"].sendall(struct.pack(">H", 3 + len(data)) + what + data)
        if what == b"V":
            answer(b"\1")
        elif what == b"v":
            answer(struct.pack(">4I", 3, 15, 8, 1))
        elif what in b"OI":
            names = (payload[8:] if what == b"O" else payload).decode().split(",")
            kinds = [kind(n) for n in names]
            client[what] = (names, ">" + "".join(SIZES.get(k, "") for k in kinds))
            answer((b"\1" if "NOT_FOUND" not in kinds else b"\0") + ",".join(kinds).encode())
        elif what == b"S":
            client["on"] = True
            answer(b"\1")
        elif what == b"U":
            names, form = client[b"I"]
            for name, value in zip(names, struct.unpack(form, payload[1:])):
                number = int(name.rsplit("_", 1)[1])
                (self.ints if "int" in name else self.doubles)[number] = value
            self.fed = self.time
            self.targets.append((time.monotonic(), self.ints[int(names[1].rsplit("_", 1)[1])], math.degrees(value)))

    def publish(self):
        for client in [c for c in self.clients if c["rtde"] and c["on"]]:
            names, form = client[b"O"]
            values = []
            for name in names:
                value = self.value(name)
                values += value if isinstance(value, list) else [value]
            data = b"\1" + struct.pack(form, *values)
            try:
                client["s"].sendall(struct.pack(">H", 3 + len(data)) + b"U" + data)
            except OSError:
                self.clients.remove(client)
