"""The helicopter of paper 004: a single-rotor machine of the R-50's class, with stabiliser bar and yaw gyro, and its own inner loop.

Plant: the hover derivatives below, body-axis kinematics without small angles, and derivatives that change with airspeed; every
aerodynamic term sees the air, not the ground. Sticks (lon, lat, ped, col) are -1..1; col = 0 carries the weight in still air.

    fx = X_u u + X_a a - 0.012 V u     p' = L_v v + L_b b - 1.2 s       a' = -q - a/tau_f + A_c/tau_f c + A_lon lon + A_lat lat
    fy = Y_v v + Y_b b - 0.03 V v      q' = M_u u + M_a a + s^2         c' = -q - c/tau_s + C_lon lon + C_lat lat
         + 0.9 s                       r' = N_v v + N_w w + N_r r       (b, d alike with p)
    fz = -g + Z_w w + Z_r r                - N_ped r_fb                 r_fb' = K_r r - K_rfb r_fb
         + Z_col col - 2.2 s^2/(1+s^2)     + N_ped ped + N_col col      s = min(V/10, 1.5)

Inner loop, each 20 ms: linear quadratic regulator on angles, rates and the rotor's states (integrated from the gyro, since nobody
measures them); heading by the pedal with its static share; thrust as collective. What a companion adds to the sticks goes on top.

Source: Song et al. 2011 (paper 004), Eqs. (1)-(6); the speed schedule is chosen.
"""

import math

import numpy as np
import scipy.linalg

from mavquad.airframe import Airframe
from mavquad.errors import ConfigError
from mavquad.jit import kernel
from sitl import config, loops, plant, rotation, rotors, sensors, vehicle
from sitl.plant import GRAVITY_M_S2
from sitl.rotation import apply, apply_t
from sitl.state import IDLE, OFF, POSITION, RATES, STICKS, Record
from sitl.vehicle import Vehicle

LON, LAT, PED, COL = range(4)
ROTOR_DIAMETER_M = 3.07
TICK_S = 0.02
_KEEP_S = 0.5  # sticks from outside are forgotten after this
_HEADING_1_S, _TURN_MAX_RAD_S = 1.2, 0.4

# derivatives at hover (1/s, m/s^2 per rad, ...), stabiliser bar and yaw gyro; an own copy on purpose
X_U, X_A, M_U, M_A = -0.0505, -9.80665, -0.184, 82.6
Y_V, Y_B, L_V, L_B = -0.154, 9.80665, 0.469, 166.0
A_C, A_LON, A_LAT, C_LON, C_LAT = 0.644, -2.174, 0.680, -0.757, 0.12
B_D, B_LON, B_LAT, D_LON, D_LAT = 0.71, 0.300, 3.043, 0.10, 0.798
TAU_F, TAU_S = 0.046, 0.342
Z_W, Z_R, N_W, N_R, N_PED, K_R, K_RFB, Z_COL, N_COL = -0.614, 0.2835, 0.0988, -4.13, 33.1, 2.16, 8.26, -13.96, -3.33

HELI = np.dtype(
    [
        ("rotor", "f8", 5),  # a, b, c, d [rad], r_fb: truth
        ("known", "f8", 5),  # the same as the inner loop knows them
        ("sticks", "f8", 4),  # lon, lat, ped, col as applied
        ("added", "f8", 4),  # on top of the inner loop
        ("added_until", "i8"),  # step
        ("given", "f8", 4),  # in place of the inner loop (kind STICKS)
        ("every", "i8"),  # steps between two passes of the inner loop
        ("K", "f8", (2, 8)),  # lon, lat from (q, theta, a, c, p, phi, b, d)
        ("K_yaw", "f8", 2),  # ped from r and r_fb
        ("scheduled", "i8"),  # 0: the hover derivatives at any speed
    ]
)


# ---- plant -----------------------------------------------------------------------------------------------------------
@kernel
def forces(air, w, rotor, sticks, scheduled):
    """(specific force, angular acceleration) in body axes: air (3,) velocity relative to the air, w rates, rotor (a, b, c, d, r_fb)."""
    speed = math.sqrt(air[0] * air[0] + air[1] * air[1] + air[2] * air[2])
    s = min(speed / 10.0, 1.5) if scheduled else 0.0
    drag = speed if scheduled else 0.0
    a, b, r_fb = rotor[0], rotor[1], rotor[4]
    ped, col = sticks[PED], sticks[COL]
    force = (
        X_U * (1.0 + 0.8 * s) * air[0] + X_A * a - 0.012 * drag * air[0],
        Y_V * (1.0 + 1.2 * s) * air[1] + Y_B * b - 0.03 * drag * air[1] + 0.9 * s,
        -GRAVITY_M_S2 + Z_W * (1.0 + s) * air[2] + Z_R * w[2] + Z_COL * (1.0 + 0.15 * s) * col - 2.2 * s * s / (1.0 + s * s),
    )
    turn = (
        (L_V * (1.0 + 0.6 * s) - 0.1 * s) * air[1] + L_B * (1.0 - 0.1 * s) * b - 1.2 * s,
        M_U * (1.0 - 1.3 * s) * air[0] + M_A * (1.0 - 0.12 * s) * a + s * s,
        0.25 * s * air[1] + N_W * air[2] + N_R * (1.0 + 0.5 * s) * w[2] - N_PED * r_fb + N_PED * ped + N_COL * col,
    )
    return force, turn


@kernel
def rotor_change(w, rotor, sticks):
    """(5,) time derivative of a, b, c, d, r_fb."""
    a, b, c, d, r_fb = rotor
    lon, lat = sticks[LON], sticks[LAT]
    return (
        -w[1] - a / TAU_F + A_C / TAU_F * c + A_LON * lon + A_LAT * lat,
        -w[0] - b / TAU_F + B_D / TAU_F * d + B_LON * lon + B_LAT * lat,
        -w[1] - c / TAU_S + C_LON * lon + C_LAT * lat,
        -w[0] - d / TAU_S + D_LON * lon + D_LAT * lat,
        K_R * w[2] - K_RFB * r_fb,
    )


@kernel
def _rates_of_change(v, R, w, rotor, wind_ned, sticks, scheduled, c):
    """(v', w', rotor', f, alpha): accelerations and what the hover derivatives in still air do not explain of them."""
    air = apply_t(R, (v[0] - wind_ned[0], v[1] - wind_ned[1], v[2] - wind_ned[2]))
    force, turn = forces(air, w, rotor, sticks, scheduled)
    still, known = forces(apply_t(R, v), w, rotor, sticks, 0)
    fx, fy, fz = apply(R, force)
    gx, gy, gz = apply(R, still)
    push = (c.push_n[0] / c.mass_kg, c.push_n[1] / c.mass_kg, c.push_n[2] / c.mass_kg)
    dv = (fx + push[0], fy + push[1], fz + push[2] + GRAVITY_M_S2)
    kick = (c.push_nm[0] / c.inertia_kg_m2[0], c.push_nm[1] / c.inertia_kg_m2[1], c.push_nm[2] / c.inertia_kg_m2[2])
    dw = (turn[0] + kick[0], turn[1] + kick[1], turn[2] + kick[2])
    f = (fx - gx + push[0], fy - gy + push[1], fz - gz + push[2])
    alpha = (dw[0] - known[0], dw[1] - known[1], dw[2] - known[2])
    return dv, dw, rotor_change(w, rotor, sticks), f, alpha


@kernel
def step(s, h, c):
    """Move on by one loop period (midpoint rule, attitude on the group) under the sticks applied."""
    dt = c.dt_s
    half = 0.5 * dt
    v = (s.v_ned_m_s[0], s.v_ned_m_s[1], s.v_ned_m_s[2])
    w = (s.omega_rad_s[0], s.omega_rad_s[1], s.omega_rad_s[2])
    R = rotation.matrix(s.R)
    wind_ned = (s.wind_ned_m_s[0], s.wind_ned_m_s[1], s.wind_ned_m_s[2])
    x = (h.rotor[0], h.rotor[1], h.rotor[2], h.rotor[3], h.rotor[4])
    sticks = (h.sticks[0], h.sticks[1], h.sticks[2], h.sticks[3])
    dv, dw, dx, _, _ = _rates_of_change(v, R, w, x, wind_ned, sticks, h.scheduled, c)
    v_mid = (v[0] + half * dv[0], v[1] + half * dv[1], v[2] + half * dv[2])
    w_mid = (w[0] + half * dw[0], w[1] + half * dw[1], w[2] + half * dw[2])
    x_mid = (
        x[0] + half * dx[0],
        x[1] + half * dx[1],
        x[2] + half * dx[2],
        x[3] + half * dx[3],
        x[4] + half * dx[4],
    )
    R_mid = rotation.mul(R, rotation.exp((half * w[0], half * w[1], half * w[2])))
    dv, dw, dx, f, alpha = _rates_of_change(v_mid, R_mid, w_mid, x_mid, wind_ned, sticks, h.scheduled, c)
    if s.grounded and dv[2] >= 0.0:  # weight on the skids
        dv = (-v[0] / dt, -v[1] / dt, -v[2] / dt)
        v_mid = (0.0, 0.0, 0.0)
        w = w_mid = plant.levelling(R)
        dw = (0.0, 0.0, 0.0)
    else:
        s.grounded = 0
        for i in range(3):
            s.disturbance_m_s2[i] += f[i]
            s.disturbance_rad_s2[i] += alpha[i]
        s.summed += 1
    R_new = rotation.orthonormal(rotation.mul(R, rotation.exp((dt * w_mid[0], dt * w_mid[1], dt * w_mid[2]))))
    for i in range(9):
        s.R[i] = R_new[i]
    for i in range(5):
        h.rotor[i] = x[i] + dt * dx[i]
    for i in range(3):
        s.p_ned_m[i] += dt * v_mid[i]
        s.v_ned_m_s[i] = v[i] + dt * dv[i]
        s.omega_rad_s[i] = w[i] + dt * dw[i]
        s.accel_ned_m_s2[i] = dv[i]
    for i in range(4):
        s.thrust_n[i] = 0.25 * c.mass_kg * (GRAVITY_M_S2 - Z_COL * sticks[COL])
    if s.p_ned_m[2] > c.ground_d_m and s.v_ned_m_s[2] >= 0.0:
        s.impact_m_s = s.v_ned_m_s[2]
        s.grounded = 1
        s.p_ned_m[2] = c.ground_d_m
        for i in range(3):
            s.accel_ned_m_s2[i] -= s.v_ned_m_s[i] / dt
            s.v_ned_m_s[i] = 0.0
    s.step += 1


# ---- inner loop ------------------------------------------------------------------------------------------------------
@kernel
def fly(s, sp, c, h):
    """One pass of the loops that are due: leaves h.sticks."""
    kind = sp.kind
    if kind == POSITION and s.step % c.position_every == 0:
        loops.aim(s, sp)
        loops.position(s, sp, c)
    elif kind not in (POSITION, OFF, IDLE, STICKS):
        s.thrust = sp.thrust
        if kind == RATES:
            d = rotation.mul(
                rotation.matrix(s.wanted_R),
                rotation.exp((c.dt_s * sp.rates_rad_s[0], c.dt_s * sp.rates_rad_s[1], c.dt_s * sp.rates_rad_s[2])),
            )
            for i in range(9):
                s.wanted_R[i] = d[i]
        else:
            for i in range(9):
                s.wanted_R[i] = sp.R[i]
    if s.step % h.every == 0:
        _sticks(s, sp, c, h)
    _know(s, c, h)


@kernel
def _sticks(s, sp, c, h):
    """The sticks for the next 20 ms."""
    kind = sp.kind
    if kind in (OFF, IDLE):
        loops.rest(s, 0.0 if kind == OFF else c.idle)
        wanted = (0.0, 0.0, 0.0, -0.7)
    elif kind == STICKS:
        wanted = (h.given[0], h.given[1], h.given[2], h.given[3])
        s.thrust = c.hover_thrust * (1.0 - Z_COL * wanted[COL] / GRAVITY_M_S2)
    else:
        roll, pitch, yaw = rotation.to_euler(rotation.matrix(s.wanted_R))
        x = (
            s.rates_rad_s[1],
            s.ahrs_euler_rad[1] - pitch,
            h.known[0],
            h.known[2],
            s.rates_rad_s[0],
            s.ahrs_euler_rad[0] - roll,
            h.known[1],
            h.known[3],
        )
        lon, lat = 0.0, 0.0
        for j in range(8):
            lon -= h.K[0, j] * x[j]
            lat -= h.K[1, j] * x[j]
        turn = (yaw - s.ahrs_euler_rad[2] + math.pi) % (2.0 * math.pi) - math.pi
        r = min(_TURN_MAX_RAD_S, max(-_TURN_MAX_RAD_S, _HEADING_1_S * turn))
        static = K_R / K_RFB - N_R / N_PED  # the pedal that keeps a turn rate
        col = -(s.thrust / c.hover_thrust - 1.0) * GRAVITY_M_S2 / Z_COL
        ped = static * r - h.K_yaw[0] * (s.rates_rad_s[2] - r) - h.K_yaw[1] * (h.known[4] - K_R / K_RFB * r)
        wanted = (lon, lat, ped - N_COL / N_PED * col, col)
        s.lift = s.thrust
        for i in range(9):
            s.target_R[i] = s.wanted_R[i]
        s.target_rates_rad_s[2] = r
    for i in range(4):
        more = h.added[i] if s.step < h.added_until and kind not in (OFF, IDLE) else 0.0
        h.sticks[i] = min(1.0, max(-1.0, wanted[i] + more))
        s.outputs[i] = 0.5 + 0.5 * h.sticks[i]
        s.pwm_us[i] = int(1000.5 + 1000.0 * s.outputs[i])


@kernel
def _know(s, c, h):
    """The rotor's states from the gyro and the sticks: stable, so nothing has to be measured."""
    x = (h.known[0], h.known[1], h.known[2], h.known[3], h.known[4])
    w = (s.rates_rad_s[0], s.rates_rad_s[1], s.rates_rad_s[2])
    sticks = (h.sticks[0], h.sticks[1], h.sticks[2], h.sticks[3])
    d = rotor_change(w, x, sticks)
    half = 0.5 * c.dt_s
    mid = (x[0] + half * d[0], x[1] + half * d[1], x[2] + half * d[2], x[3] + half * d[3], x[4] + half * d[4])
    d = rotor_change(w, mid, sticks)
    for i in range(5):
        h.known[i] = x[i] + c.dt_s * d[i]


@kernel
def advance(machine, setpoint, constants, heli, gusts, normals, steps):
    """`steps` periods of the loop: inner loop, air, plant, sensors."""
    s, sp, c, h = machine[0], setpoint[0], constants[0], heli[0]
    for _ in range(steps):
        n = normals[s.step % normals.shape[0]]
        fly(s, sp, c, h)
        if s.step % c.air_every == 0:
            vehicle.air(s, c, gusts, n)
        step(s, h, c)
        sensors.sense(s, c, n)


class Helicopter(Vehicle):
    """The helicopter as a vehicle of the simulator; `heli` holds what only it has."""

    mav_type = 4

    def __init__(self, sitl: config.Sitl) -> None:
        if sitl.personality != "px4":
            raise ConfigError('the helicopter flies with personality = "px4" only: an ArduPilot helicopter is another firmware')
        self.heli = Record(HELI)
        super().__init__(sitl)
        self.heli["K"], self.heli["K_yaw"] = regulator()
        self.heli["every"] = round(TICK_S * sitl.rate_hz)
        self.heli["scheduled"] = 1

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self.state.array, self.setpoint.array, self.constants.array, self.heli.array, self._gusts, self._normals

    def actuate(self, steps: int) -> None:
        advance(*self.arrays, steps)

    def give_sticks(self, lat: float, lon: float, ped: float, col: float) -> None:
        """Sticks in place of the inner loop, while the setpoint's kind is STICKS."""
        self.heli["given"] = lon, lat, ped, col

    def add_sticks(self, lat: float, lon: float, ped: float, col: float) -> None:
        """Sticks on top of the inner loop, for half a second."""
        self.heli["added"] = lon, lat, ped, col
        self.heli["added_until"] = self.state["step"] + round(_KEEP_S * 1e6 / self.dt_us)

    def sticks(self) -> tuple[float, float, float, float]:
        """(lat, lon, ped, col) as applied now."""
        lon, lat, ped, col = self.heli["sticks"].tolist()
        return lat, lon, ped, col

    def _fill_body(self, sitl: config.Sitl, true: Airframe) -> None:
        c = self.constants
        c["dt_s"] = 1e-6 * self.dt_us
        c["ground_d_m"] = sitl.start.p_ned_m[2]
        c["mass_kg"], c["inertia_kg_m2"] = true.body.mass_kg, true.body.inertia_kg_m2
        c["thrust_max_n"] = 0.5 * true.body.mass_kg * GRAVITY_M_S2  # of each quarter of the rotor
        c["effectiveness"] = 1.0

    def _span_m(self, true: Airframe) -> float:
        return ROTOR_DIAMETER_M

    def _fill_tuning(self, sitl: config.Sitl, tuned: Airframe) -> None:
        c = self.constants
        c["personality"] = vehicle.TUNING[sitl.personality].number
        c["tuned_inertia"] = tuned.body.inertia_kg_m2
        c["hover_thrust"] = tuned.hover_thrust
        c["position_every"] = sitl.rate_hz // 100
        c["accel_max"] = 4.0
        c["rotor_model"] = rotors.NO_INFLOW


def regulator() -> tuple[np.ndarray, np.ndarray]:
    """(K (2, 8), K_yaw (2,)) at 50 Hz: weights 4 on angles, 0.02 on rates, 1e-4 on speeds (whose error is not fed back), 1 on sticks."""
    f, t = 1.0 / TAU_F, 1.0 / TAU_S
    lon = [[X_U, 0, -GRAVITY_M_S2, X_A, 0], [M_U, 0, 0, M_A, 0], [0, 1, 0, 0, 0], [0, -1, 0, -f, A_C * f], [0, -1, 0, 0, -t]]
    lat = [[Y_V, 0, GRAVITY_M_S2, Y_B, 0], [L_V, 0, 0, L_B, 0], [0, 1, 0, 0, 0], [0, -1, 0, -f, B_D * f], [0, -1, 0, 0, -t]]
    a = scipy.linalg.block_diag(np.array(lon, float), np.array(lat, float))
    b = np.zeros((10, 2))
    b[3:5] = [[A_LON, A_LAT], [C_LON, C_LAT]]
    b[8:] = [[B_LON, B_LAT], [D_LON, D_LAT]]
    k = _dlqr(a, b, np.array([1e-4, 0.02, 4.0, 0.0, 0.0] * 2))
    yaw = _dlqr(np.array([[N_R, -N_PED], [K_R, -K_RFB]]), np.array([[N_PED], [0.0]]), np.array([0.01, 0.0]))
    return k[:, [1, 2, 3, 4, 6, 7, 8, 9]], yaw[0]


def _dlqr(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> np.ndarray:
    n, m = b.shape
    block = scipy.linalg.expm(np.block([[a, b], [np.zeros((m, n + m))]]) * TICK_S)
    ad, bd = block[:n, :n], block[:n, n:]
    p = scipy.linalg.solve_discrete_are(ad, bd, np.diag(weights), np.eye(m))
    gain: np.ndarray = np.linalg.solve(np.eye(m) + bd.T @ p @ bd, bd.T @ p @ ad)
    return gain
