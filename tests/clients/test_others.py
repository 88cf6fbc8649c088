"""MAVProxy on both personalities, node-mavlink on the stream, pymavlink's own tools on the logs."""

import json
import subprocess
import time

import pytest

from tests.clients.conftest import PROGRAMS

pytestmark = pytest.mark.slow

MODES = {  # what is typed to take off and to land: MAVProxy 1.8.75 cannot name a mode of PX4 ("required argument is not a float")
    "px4": ("takeoff 493", "TAKEOFF", "long DO_SET_MODE 1 4 6", "LAND"),
    "ardupilot": ("takeoff 5", "GUIDED", "mode LAND", "LAND"),
}


class MavProxy:
    """MAVProxy as a person runs it: lines typed, text read back."""

    def __init__(self, python, port, folder):
        self._out = folder / "mavproxy.txt"
        with self._out.open("w") as out:
            self._process = subprocess.Popen(
                [
                    *(python, python.parent / "mavproxy.py", f"--master=udpout:127.0.0.1:{port}", f"--state-basedir={folder}"),
                    "--default-modules=link,log,param,arm,mode,cmdlong,misc,ftp,wp,fence,rally",
                ],
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=subprocess.STDOUT,
                text=True,
                cwd=folder,
            )

    def type(self, line):
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def wait(self, text, seconds=30.0):
        """Until it has printed a text since the last time."""
        end = time.monotonic() + seconds
        while text not in self.printed():
            assert time.monotonic() < end, f"MAVProxy did not say {text!r} in {seconds} s:\n{self.printed()}"
            time.sleep(0.2)

    def printed(self):
        return self._out.read_text()

    def close(self):
        self._process.stdin.close()  # it ends by itself at the end of its input, not by a signal
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@pytest.mark.parametrize("personality", MODES)
def test_mavproxy_connects_loads_parameters_arms_and_changes_mode(personality, sitl, client_python, tmp_path):
    vehicle = sitl(personality)
    proxy = MavProxy(client_python, vehicle.port, tmp_path)
    take_off, flying, down, landing = MODES[personality]
    try:
        proxy.wait("Detected vehicle 1:1")
        proxy.wait("Received ")
        if personality == "ardupilot":
            proxy.wait("EKF3 IMU0 origin set")
            proxy.type("mode GUIDED")
            proxy.wait("Mode GUIDED")
        time.sleep(2.0)
        proxy.type("arm throttle")
        proxy.wait("ARMED")
        proxy.type(take_off)
        proxy.wait(f"Mode {flying}")
        time.sleep(4.0)
        proxy.type(down)
        proxy.wait(f"Mode {landing}")
        proxy.type("wp list")
        proxy.wait("Requesting 0 waypoints")
        proxy.type("ftp list")
        proxy.wait("opcode:129")
        proxy.type("status")
        proxy.wait("MAV Errors: 0")
    finally:
        proxy.close()
    loaded = next(line for line in proxy.printed().splitlines() if line.startswith("Received "))
    saved = (tmp_path / "mav.parm").read_text().splitlines()
    assert int(loaded.split()[1]) == len([line for line in saved if line and not line.startswith("#")])


@pytest.mark.parametrize("personality", MODES)
def test_node_mavlink_decodes_the_stream(personality, sitl, node_mavlink):
    vehicle = sitl(personality)
    done = subprocess.run(
        ["node", PROGRAMS / "decode.mjs", node_mavlink, str(vehicle.port), "5"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    seen = json.loads(done.stdout)
    assert (seen["invalid"], seen["unknown"], seen["gaps"]) == (0, [], 0)
    assert seen["counts"]["ATTITUDE_QUATERNION"] > 100
    assert seen["acks"] == {"511": 0, "520": 0, "31999": 3}
    attitude, imu = seen["last"]["ATTITUDE_QUATERNION"], seen["last"]["HIGHRES_IMU"]
    assert sum(attitude[f"q{i}"] ** 2 for i in (1, 2, 3, 4)) == pytest.approx(1.0, abs=1e-5)
    assert imu["zacc"] == pytest.approx(-9.8, abs=0.3)
    assert seen["last"]["AUTOPILOT_VERSION"]["capabilities"] & 64


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """The logs of one short flight of both programs."""
    from tools import __main__ as tools_main

    run = tmp_path_factory.mktemp("clients") / "run"
    words = ["--seed", "7", "--set", "path.duration_s=3", "--set", "flight.takeoff_m=2", "--no-report", "--run", str(run)]
    assert tools_main.main(["fly", "hover", *words, "--json"]) == 0
    return run


def tool(python, name, *words):
    """What one of pymavlink's programs prints."""
    done = subprocess.run(
        [python, python.parent / name, *map(str, words)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["flight.tlog", "sitl.tlog"])
def test_pymavlinks_tools_read_our_logs(name, flight, client_python):
    log = flight / name
    dumped = tool(client_python, "mavlogdump.py", "--types", "ATTITUDE_QUATERNION", log)
    assert dumped.count("ATTITUDE_QUATERNION") > 500
    assert "BAD_DATA" not in tool(client_python, "mavlogdump.py", "--show-types", log)
    assert " 0 lost" in tool(client_python, "mavloss.py", log)
    assert "Num Flights : 1" in tool(client_python, "mavsummarize.py", log)
    modes = tool(client_python, "mavflightmodes.py", log)
    assert all(f"MAV.flightmode={mode} " in modes for mode in ("TAKEOFF", "OFFBOARD", "LAND"))
    assert tool(client_python, "mavparms.py", log).split() == ["MPC_THR_HOVER", "0.573500"]
