"""Parts of a flight in bulk in a loop of their own, for `mavquad bench bulk`: what each of them costs."""

from mavquad.jit import kernel
from sitl import loops, plant
from sitl.vehicle import air
from tools.bulk import lean


@kernel
def plant_alone(vehicle, setpoint, constants, gusts, noise, steps):
    """The rigid body with its rotors under outputs that stay."""
    s, c = vehicle[0], constants[0]
    for _ in range(steps):
        plant.step(s, c)


@kernel
def step_on_truth(s, sp, c):
    """One step of attitude and rate loops that know the truth, and of the plant under their outputs."""
    for i in range(9):
        s.ahrs_R[i] = s.R[i]
    for i in range(3):
        s.rates_rad_s[i] = s.omega_rad_s[i]
    loops.run(s, sp, c)
    plant.step(s, c)


@kernel
def with_loops(vehicle, setpoint, constants, gusts, noise, steps):
    """The rigid body under the autopilot's loops, which know the truth."""
    s, sp, c = vehicle[0], setpoint[0], constants[0]
    for _ in range(steps):
        step_on_truth(s, sp, c)


@kernel
def with_sensors(vehicle, setpoint, constants, gusts, noise, steps):
    """The same under noisy sensors and turbulence."""
    s, sp, c, n = vehicle[0], setpoint[0], constants[0], noise[0]
    for _ in range(steps):
        lean.draw(s, c, n)
        loops.run(s, sp, c)
        if s.step % c.air_every == 0:
            air(s, c, gusts, n.normals)
        plant.step(s, c)
        lean.sense(s, c, n.normals)
