"""The simulated autopilot as its peers meet it: whole flights in one process on vehicle time, and one over real UDP."""

import json
import math
import socket
import subprocess
import sys
from collections import Counter
from itertools import pairwise

import pytest

from mavquad import wire
from tests.oracles.client import HOVER, Client


@pytest.fixture
def flying():
    client = Client()
    client.take_off()
    return client


def test_a_flight_from_the_ground_to_the_ground(flying):
    c = flying
    assert c.where == pytest.approx((0.0, 0.0, -5.0), abs=0.15)  # noise 0.02 m and the loop's answer to it
    assert c.last["HEARTBEAT"].custom_mode == 4 << 16 | 3 << 24  # AUTO.LOITER
    c.run(1.5, c.attitude)
    assert c.command(176, 1, 6, 0) == 0
    c.run(2.0, lambda: c.attitude(roll=0.1, thrust=HOVER / math.cos(0.1)))
    assert c.last["HEARTBEAT"].custom_mode == 6 << 16
    assert c.where[1] > 0.8  # positive roll goes east; g tan(0.1) for 2 s is 2 m less the lag and drag
    assert c.last["ATTITUDE"].roll == pytest.approx(0.1, abs=0.02)
    assert c.sim.misses == 0
    assert c.command(21) == 0
    c.run(16.0)
    assert c.last["EXTENDED_SYS_STATE"].landed_state == 1
    assert not c.last["HEARTBEAT"].base_mode & 128
    assert "Landing detected" in c.texts
    assert c.sim.autopilot.ended_us > 0
    assert not c.sim.autopilot.crashed


def test_default_streams_come_at_their_rates(flying):
    before = Counter(flying.counts)
    flying.run(10.0)
    got = {name: flying.counts[name] - before[name] for name in flying.counts}
    expected = {"ATTITUDE_QUATERNION": 2500, "HIGHRES_IMU": 2500, "SERVO_OUTPUT_RAW": 2500, "ATTITUDE": 1000}
    expected |= {"LOCAL_POSITION_NED": 500, "ATTITUDE_TARGET": 500, "HEARTBEAT": 10}
    assert {name: got[name] for name in expected} == pytest.approx(expected, abs=2)
    assert "ATT_POS_MOCAP" not in got


def test_position_setpoints_are_flown_by_the_autopilots_own_loop(flying):
    c = flying
    c.run(1.2, lambda: c.position((2.0, -1.0, -6.0)))
    assert c.command(176, 1, 6, 0) == 0
    c.run(7.0, lambda: c.position((2.0, -1.0, -6.0), yaw=1.0))
    assert c.where == pytest.approx((2.0, -1.0, -6.0), abs=0.2)
    assert c.last["ATTITUDE"].yaw == pytest.approx(1.0, abs=0.05)


def test_velocity_and_acceleration_feed_forward_follow_a_circle(flying):
    c = flying
    start = c.sim.t_us * 1e-6

    def circle(forward):
        w, s = 2.0 / 3.0, c.sim.t_us * 1e-6 - start
        p = (3.0 * math.sin(w * s), 3.0 - 3.0 * math.cos(w * s), -5.0)
        v = (2.0 * math.cos(w * s), 2.0 * math.sin(w * s), 0.0)
        a = (-2.0 * w * math.sin(w * s), 2.0 * w * math.cos(w * s), 0.0)
        c.position(p, v, a, mask=0 if forward else 56 | 448)
        return p

    def worst(forward):
        errors = []
        c.run(9.0, lambda: errors.append(math.dist(circle(forward), c.where)))
        return max(errors[-500:])

    c.run(1.2, lambda: circle(True))
    assert c.command(176, 1, 6, 0) == 0
    c.run(6.0, lambda: circle(True))
    assert worst(True) < 0.5 * worst(False)


def test_body_rates_are_flown(flying):
    c = flying
    rates = (0.0, 0.0, 0.4)
    c.run(1.2, lambda: c.attitude(mask=128, rates=rates))
    assert c.command(176, 1, 6, 0) == 0
    c.run(2.0, lambda: c.attitude(mask=128, rates=rates))
    m = c.last["ATTITUDE_QUATERNION"]
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == pytest.approx(rates, abs=0.03)
    assert c.last["ATTITUDE_TARGET"].type_mask & 128


def test_offboard_needs_setpoints_and_ends_when_they_stop(flying):
    c = flying
    assert c.command(176, 1, 6, 0) == 1
    assert any("Offboard refused" in text for text in c.texts)
    c.run(1.2, c.attitude)
    assert c.command(176, 1, 6, 0) == 0
    c.run(1.0, c.attitude)
    c.run(2.0)
    assert c.last["HEARTBEAT"].custom_mode == 4 << 16 | 3 << 24
    assert any("setpoints lost" in text for text in c.texts)
    assert c.sim.misses > 50  # one each 8 ms until the second was over


@pytest.mark.parametrize(("action", "mode"), [(0, 4 << 16 | 6 << 24), (2, 4 << 16 | 5 << 24)])
def test_what_follows_lost_setpoints_is_a_parameter(action, mode):
    c = Client(f"params={{ COM_OBL_ACT = {action} }}")
    c.take_off()
    c.run(1.2, c.attitude)
    assert c.command(176, 1, 6, 0) == 0
    c.run(2.0)
    assert c.last["HEARTBEAT"].custom_mode == mode


def test_unusable_setpoints_do_not_count(flying):
    c = flying
    for q in ((0.0, 0.0, 0.0, 0.0), (1.01, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0)):
        c.run(1.2, lambda q=q: c.send("SET_ATTITUDE_TARGET", 0, 1, 1, 7, q, 0.0, 0.0, 0.0, HOVER))
        assert c.command(176, 1, 6, 0) == 1
    c.run(1.2, lambda: c.send("SET_ATTITUDE_TARGET", 0, 2, 1, 7, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, HOVER))  # not for us
    assert c.command(176, 1, 6, 0) == 1


def test_services_answer():
    c = Client()
    c.run(1.5)
    assert c.command(512, 148) == 0
    assert c.last["AUTOPILOT_VERSION"].capabilities & 64
    assert c.command(31999) == 3
    assert c.command(511, 31, 10_000) == 0
    c.send("TIMESYNC", 0, 12345)
    c.send("MISSION_REQUEST_LIST", 1, 1, 0)
    c.send("FILE_TRANSFER_PROTOCOL", 0, 1, 1, (7, 0, 0, 3) + (0,) * 247)
    c.send("PING", 77, 5, 0, 0)
    before = c.counts["ATTITUDE_QUATERNION"]
    c.run(1.0)
    assert c.counts["ATTITUDE_QUATERNION"] - before == pytest.approx(100, abs=2)
    assert c.last["TIMESYNC"].ts1 == 12345
    assert c.last["TIMESYNC"].tc1 == pytest.approx(c.sim.t_us * 1000, abs=1.1e9)
    assert c.last["MISSION_COUNT"].count == 0
    assert c.last["FILE_TRANSFER_PROTOCOL"].payload[3] == 129
    assert (c.last["PING"].seq, c.last["PING"].target_component) == (5, 191)
    assert c.command(400, 1) == 0
    assert c.command(512, 242) == 0
    assert c.last["HOME_POSITION"].latitude == pytest.approx(473977420, abs=50)


def test_the_motion_capture_is_white_and_has_its_own_rate():
    c = Client("attitude_source=both")
    c.run(0.5)
    before, seen = c.counts["ATT_POS_MOCAP"], []
    for _ in range(400):
        c.period()
        seen.append(2.0 * c.last["ATT_POS_MOCAP"].q[1])
    assert c.counts["ATT_POS_MOCAP"] - before == 320
    draws = sorted(set(seen))
    sigma = math.sqrt(sum(x * x for x in draws) / len(draws))
    assert sigma == pytest.approx(math.radians(0.2), rel=0.2)


def test_sequence_numbers_count_every_frame_of_a_link():
    c = Client("link.delay_ms=5")
    numbers = []
    for _ in range(100):
        c.sim.run_period()
        for data in c.sim.collect(c.link):
            numbers += [frame.seq for frame in wire.split(data)[0]]
    assert [(b - a) & 0xFF for a, b in pairwise(numbers)] == [1] * (len(numbers) - 1)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others():
    def flight(seed):
        log = []
        c = Client(f"seed={seed}", "wind.mean_m_s=4", "wind.w20_m_s=8", record=lambda t_us, data: log.append(data))
        c.take_off(2.0)
        c.run(1.2, c.attitude)
        return b"".join(log)

    first = flight(3)
    assert first == flight(3)
    assert first != flight(4)


def test_the_companions_mass_guess_may_be_wrong_and_the_hover_still_holds():
    c = Client('overrides=["body.mass_kg=+20%"]')
    c.take_off()
    c.run(6.0)
    assert c.where == pytest.approx((0.0, 0.0, -5.0), abs=0.2)
    assert c.last["ATTITUDE_TARGET"].thrust == pytest.approx(1.2 * HOVER, rel=0.05)


# ---- over real UDP ------------------------------------------------------------------------------------------------------
@pytest.fixture
def sitl_process(tmp_path):
    """`python -m sitl` on a socket of ours, in lockstep, as `mavquad fly` starts it."""
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", 0))
    log = tmp_path / "sitl.tlog"
    words = f"-P -m sitl --socket-fd {server.fileno()} --lockstep --log {log} --exit-when-landed 0.5 --max-time 60"
    process = subprocess.Popen(
        [sys.executable, *words.split()],
        pass_fds=[server.fileno()],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect(server.getsockname())
    client.settimeout(0.5)
    server.close()
    yield process, client, log
    process.kill()
    process.communicate()
    client.close()


def test_a_lockstep_flight_over_udp(sitl_process):
    process, client, log = sitl_process
    seq, acks, mode = 0, {}, None

    def frame(name, *fields):
        nonlocal seq
        seq += 1
        return wire.encode(name, fields, seq=seq - 1, system=1, component=191)

    def command(number, *params):
        return frame("COMMAND_LONG", 1, 1, number, 0, *(tuple(params) + (math.nan,) * (7 - len(params))))

    plan = {150: (400, 1.0), 160: (22, 0, 0, 0, math.nan, math.nan, math.nan, 490.0), 800: (176, 1, 6, 0), 900: (21,)}
    hello = wire.encode("HEARTBEAT", (18, 8, 0, 0, 4, 3), seq=0, system=1, component=191)
    client.send(hello)
    period = 0
    while True:
        try:
            data = client.recv(65536)
        except TimeoutError:
            if process.poll() is None:
                continue
            break  # it has landed and gone
        barrier = None
        for _, m in wire.parse(data):
            name = type(m).__name__
            if name == "TIMESYNC" and m.tc1 == 0:
                barrier = m.ts1
            elif name == "COMMAND_ACK":
                acks[m.command] = m.result
            elif name == "HEARTBEAT":
                mode = m.custom_mode if m.custom_mode >> 16 & 0xFF == 6 else mode
        if barrier is None:
            continue
        period += 1
        out = [frame("HEARTBEAT", 18, 8, 0, 0, 4, 3)] if period % 125 == 1 else []
        if period in plan:
            out.append(command(*plan[period]))
        if 600 <= period < 900:
            out.append(frame("SET_ATTITUDE_TARGET", 0, 1, 1, 7, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, HOVER))
        out.append(frame("TIMESYNC", barrier, barrier))
        client.send(b"".join(out))
    stdout, stderr = process.communicate(timeout=90)
    report = json.loads(stdout)
    assert process.returncode == 0, stderr
    assert acks == {400: 0, 22: 0, 176: 0, 21: 0}
    assert mode == 6 << 16
    assert report["landed"]
    assert report["setpoint_misses"] == 0
    assert report["periods"] == period
    names = Counter(wire.NAME[wire.split(raw)[0][0].msgid] for raw in _records(log))
    assert names["ODOMETRY"] == names["DEBUG_FLOAT_ARRAY"] == period
    assert names["HEARTBEAT"] >= 2 * (period // 125) - 1
    assert names["TIMESYNC"] == 2 * period


def _records(path):
    data, at = path.read_bytes(), 0
    while at < len(data):
        size = 12 + data[at + 9]
        yield data[at + 8 : at + 8 + size]
        at += 8 + size


def test_an_endpoint_in_use_is_said_in_one_line():
    taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    taken.bind(("127.0.0.1", 0))
    port = taken.getsockname()[1]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "sitl", "--endpoint", f"udpin:127.0.0.1:{port}"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    taken.close()
    assert done.returncode == 1
    assert done.stderr.startswith(f"sitl: udpin:127.0.0.1:{port}: cannot listen there: Address already in use;")
    assert done.stderr.count("\n") == 1


# ---- parameters, several peers, a bad wire --------------------------------------------------------------------------------
def test_parameters_are_listed_read_set_and_at_work():
    c = Client()
    c.run(0.5)
    seen = {}
    c.on = lambda m: seen.update({m.param_id: m}) if type(m).__name__ == "PARAM_VALUE" else None
    c.send("PARAM_REQUEST_LIST", 1, 1)
    c.run(1.0)
    assert len(seen) == seen["MPC_XY_P"].param_count == len(c.sim.autopilot.params)
    assert {m.param_index for m in seen.values()} == set(range(len(seen)))
    c.send("PARAM_SET", 1, 1, "MPC_XY_P", 1.5, 9)
    c.send("PARAM_REQUEST_READ", 1, 1, "", seen["MPC_TKO_SPEED"].param_index)
    c.send("PARAM_REQUEST_READ", 1, 1, "NO_SUCH_NAME", -1)
    seen.clear()
    c.run(0.1)
    assert set(seen) == {"MPC_XY_P", "MPC_TKO_SPEED"}
    assert seen["MPC_XY_P"].param_value == 1.5
    assert c.sim.vehicle.constants["position_p"][0] == 1.5


def test_frames_are_routed_to_where_their_addressee_was_heard():
    c = Client()
    c.run(0.2)
    station, bystander = c.sim.open_link(), c.sim.open_link()
    heartbeat = wire.encode("HEARTBEAT", (6, 8, 0, 0, 4, 3), seq=0, system=255, component=190)
    c.sim.receive(station, heartbeat)
    c.sim.receive(bystander, wire.encode("HEARTBEAT", (6, 8, 0, 0, 4, 3), seq=0, system=254, component=190))
    got = {"station": [], "bystander": []}

    def listen():
        c.period()
        for name, link in (("station", station), ("bystander", bystander)):
            for data in c.sim.collect(link):
                got[name] += [frame for frame in wire.split(data)[0] if frame.system != 1 or frame.component != 1]

    c.send("HEARTBEAT", 18, 8, 0, 0, 4, 3)  # for everybody
    for _ in range(5):
        listen()
    assert [f.msgid for f in got["station"]] == [f.msgid for f in got["bystander"]] == [0, 0]  # each other's and ours
    c.send("COMMAND_LONG", 255, 190, 31000, 0, *(0.0,) * 7)  # for the station alone
    c.send("PARAM_SET", 1, 1, "MPC_XY_P", 1.0, 9)  # for the autopilot alone
    for _ in range(5):
        listen()
    assert [f.msgid for f in got["station"]][2:] == [76]
    assert len(got["bystander"]) == 2
    c.sim.receive(station, wire.encode("COMMAND_LONG", (1, 191, 300, 0, *(0.0,) * 7), seq=1, system=255, component=190))
    c.run(0.1)
    assert c.last["COMMAND_LONG"].command == 300  # a ground station reaches the companion through the autopilot


def test_links_have_their_own_rates_and_sequences():
    c = Client("link.delay_ms=0")
    c.run(0.1)
    other = c.sim.open_link()
    c.command(511, 31, -1)
    c.run(0.1)
    c.sim.collect(other)
    before = c.counts["ATTITUDE_QUATERNION"]
    c.run(0.2)
    frames = [frame for data in c.sim.collect(other) for frame in wire.split(data)[0]]
    assert c.counts["ATTITUDE_QUATERNION"] == before
    assert sum(frame.msgid == 31 for frame in frames) == 50
    assert all((b.seq - a.seq) & 0xFF == 1 for a, b in pairwise(frames))


def test_a_bad_wire_is_survived_and_loss_shows_in_the_sequence():
    c = Client("link.loss=0.05", "link.corrupt=0.02", "link.duplicate=0.02", "link.jitter_ms=4", "link.reorder=0.01")
    gaps = received = 0
    last = None
    refused = 0
    for _ in range(400):
        c.send("HEARTBEAT", 18, 8, 0, 0, 4, 3)
        c.sim.run_period()
        for data in c.sim.collect(c.link):
            frames, junk, rest = wire.split(data)
            refused += junk + len(rest)
            for frame in frames:
                received += 1
                gaps += last is not None and (frame.seq - last) & 0xFF != 1
                last = frame.seq
    counts = c.link.down.counts
    assert min(counts.values()) > 10
    assert refused > 0
    assert gaps > counts["lost"] / 2
    # a changed length byte hides its neighbours in the datagram, a changed id passes as an unknown message: a few either way
    whole = c.link.sent - counts["lost"] - counts["corrupted"] + counts["duplicated"]
    assert received == pytest.approx(whole, abs=counts["corrupted"])
    assert c.link.refused > 0  # corrupted on the way up


def test_a_forwarded_copy_holds_both_directions(tmp_path):
    monitor = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    monitor.bind(("127.0.0.1", 0))
    monitor.settimeout(90.0)
    probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
    probe.close()
    words = f"-P -m sitl --endpoint udpin:127.0.0.1:{port} --forward udpout:127.0.0.1:{monitor.getsockname()[1]} --speed 20"
    process = subprocess.Popen([sys.executable, *words.split()], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.settimeout(0.2)
    hello = wire.encode("HEARTBEAT", (18, 8, 0, 0, 4, 3), seq=0, system=1, component=191)
    try:
        for _ in range(300):
            client.sendto(hello, ("127.0.0.1", port))
            try:
                client.recv(65536)
                break
            except (TimeoutError, ConnectionRefusedError):
                continue
        senders = set()
        for _ in range(3000):  # however many heartbeats it took to find the simulator, its own frames follow
            if len(senders) == 2:
                break
            senders |= {(frame.system, frame.component) for frame in wire.split(monitor.recv(65536))[0]}
        assert senders == {(1, 1), (1, 191)}
    finally:
        process.terminate()  # ends cleanly, with its report
        stdout, stderr = process.communicate(timeout=90)
        client.close()
        monitor.close()
    assert process.returncode == 0, stderr
    assert json.loads(stdout)["messages_sent"] > 0
