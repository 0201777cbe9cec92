"""Schema of a mission: every table of the format, with the unit and meaning of each key.

The descriptions document the format: `rigidfleet missions --schema` exports them, and docs/missions.md has them.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    Field,
    Strict,
    model_validator,
)

from rigidfleet._common.waypoints import SHAPE_TOLERANCE
from rigidfleet.formation import distance_geometry, graphs, shapes
from rigidfleet.math import pid, rigid_body
from rigidfleet.mission import bounds
from rigidfleet.mission.bounds import (
    ACCELERATION,
    FORCE,
    GAIN,
    MASS,
)
from rigidfleet.mission.kinds import Phase
from rigidfleet.mission.obstacles import Obstacle
from rigidfleet.mission.values import (
    NAME_OR_LIST,
    Acceleration,
    AgentNumber,
    Angle,
    AttitudeGains,
    BodyDrag,
    Coefficient,
    Colour,
    Coordinate,
    Cost,
    Damping,
    Delay,
    Edges,
    Flag,
    Gain,
    Inertia,
    Jerk,
    Length,
    LengthOrZero,
    Limit,
    Mass,
    MotorTimes,
    Part,
    PerAgent,
    PerAgentError,
    PerAxis,
    Rate,
    Rest,
    RotorSpeeds,
    Seconds,
    Seed,
    Share,
    Size,
    Small,
    Speed,
    Spread,
    Tilt,
    Time,
    Tolerance,
    Vector,
    Velocity,
    Weight,
    Weights,
    Whole,
    from_zero,
    number_or_list,
    of_either_sign,
)
from rigidfleet.typing import Floats, Ints

#: Default drag coefficient of a vehicle per mass [1/s]. At the speeds of formation flight, rotor drag dominates, which
#: is linear in the speed. Identified from flights: 0.4 to 0.5 /s along two axes of a quadrotor (Faessler, Franchi,
#: Scaramuzza, Robotics and Automation Letters 3, 2018). A vehicle with more mass per rotor has less.
DRAG = 0.3


class Start(Part):
    """Start positions of the agents on the slots of a named shape, in their order."""

    shape: str = Field(
        description=f"named shape: {', '.join(shapes.SHAPES)}",
        json_schema_extra={"enum": [*shapes.SHAPES]},
    )
    size: Size = Field(description="edge length of the shape [m], or its three sizes")
    count: Annotated[int, Strict(), Field(ge=1, le=bounds.AGENTS)] = Field(
        description="number of agents"
    )
    centre: Vector = Field((0.0, 0.0, 0.0), description="centre of the shape [x, y, z] [m]")

    def points(self) -> Floats:
        """Positions (count, 3) [m].

        Raises
        ------
        ValueError
            The shape is unknown or does not suit the number of agents or sizes.
        """
        return shapes.slots(self.shape, self.size, self.count) + np.array(self.centre)


class Vehicle(Part):
    """A model of vehicle. Keys that are not given are those of the model; `rigidfleet.mission.vehicles` has them."""

    model: Literal["point", "paper", "px4-sih", "hummingbird", "crazyflie", "x500"] = Field(
        description="point: a point mass that gives any force at once; the others are quadrotors: paper: the paper's, "
        "1 kg with four rotors of 5.9 N; px4-sih: PX4's simulation in hardware; hummingbird: AscTec Hummingbird; "
        "crazyflie: Crazyflie 2; x500: Holybro X500"
    )
    mass: Mass | None = Field(None, description="mass [kg]; required for a point")
    inertia: Inertia | None = Field(
        None, description="moments of inertia about the body's axes [x, y, z] [kg m^2]"
    )
    arm: Length | None = Field(
        None, description="distance of each rotor from the centre of mass [m]; rotors form an X"
    )
    thrust_coefficient: Small | None = Field(
        None, description="k_f [N s^2/rad^2]: a rotor's thrust is k_f times the square of its speed"
    )
    torque_coefficient: Small | None = Field(
        None,
        description="k_m [N m s^2/rad^2]: its drag torque is k_m times the square of its speed",
    )
    rotor_speed: RotorSpeeds | None = Field(
        None, description="[least, greatest] speed of a rotor [rad/s]"
    )
    motor_time: MotorTimes | None = Field(
        None,
        description="time constants of the motors [s]: [up, down], how quickly rotors speed up and slow down",
    )
    rotor_drag: Coefficient | None = Field(
        None,
        description="k_d [kg/rad]: drag of a rotor per its speed and the air's speed across its axis",
    )
    rotor_inflow: Coefficient | None = Field(
        None, description="k_z [kg/rad]: the same along its axis"
    )
    rotor_lift: Coefficient | None = Field(
        None,
        description="k_h [kg/m]: additional thrust of a rotor per square of the air's speed across it",
    )
    body_drag: BodyDrag | None = Field(
        None, description="drag of the body per square of the air's speed [x, y, z] [N s^2/m^2]"
    )
    rotor_radius: Length | None = Field(
        None, description="radius of a rotor [m], for downwash and ground effect"
    )
    attitude_gains: AttitudeGains | None = Field(
        None,
        description="[k_R, k_omega] of the attitude control per moment of inertia [1/s^2, 1/s]",
    )
    tilt_limit_deg: Tilt | None = Field(
        None, description="maximum tilt that the attitude control commands [deg]"
    )
    thrust_limit: Limit | None = Field(
        None, description="maximum thrust [N], only for a point; default: unlimited"
    )
    drag: Weight | None = Field(
        None,
        description="drag force per velocity relative to the air [N s/m], only for a point; default: 0",
    )


class Autopilot(Part):
    """Sampled control on board: how often each vehicle's computer acts. Only with [vehicles]."""

    rate: Rate = Field(
        500.0, description="rate of the attitude control [Hz]; commands are held in between"
    )
    formation_rate: Rate = Field(
        100.0,
        description="rate of the formation's laws [Hz], which give each vehicle its force; rate is a multiple of it",
    )
    delay_compensation: Flag = Field(
        True,
        description="true: measurements carry their time, and are compared with the reference of that time, while "
        "slots are tracked; false: with the reference of now",
    )
    step: Annotated[float, Strict(), Field(ge=1e-5, le=0.01)] = Field(
        0.001, description="longest step of the integrator, a fourth-order Runge-Kutta method [s]"
    )


class Avoidance(Part):
    """Avoidance in flight, at the rate of the formation's laws; see docs/avoidance.md. Only with [vehicles]."""

    guard: Flag = Field(
        True,
        description="true: a vehicle does only what leaves all of them able to brake in time",
    )
    barrier: Flag = Field(
        True,
        description="true: barriers change accelerations early and as little as possible, and edges of a formation let "
        "go near them",
    )
    clock: Flag = Field(
        True,
        description="true: a formation waits on its path while an obstacle that moves passes",
    )
    patience: Annotated[float, Strict(), Field(ge=0, le=3600)] = Field(
        30.0, description="time by which a phase may end later because its formation waits [s]"
    )
    body: Flag = Field(
        True,
        description="true: a formation is steered round obstacles that move as one body, before single agents give "
        "way",
    )
    separation: LengthOrZero | None = Field(
        None, description="separation of agents to keep [m]; default: that of [limits], or 0"
    )
    clearance: LengthOrZero = Field(
        0.0, description="distance of an agent's surface from obstacles to keep [m]"
    )
    margin: LengthOrZero | None = Field(
        None,
        description="by which each agent is taken to be larger [m]; default: three times the noise of positions, and "
        "0.02 m for a quadrotor",
    )
    rate: Annotated[float, Strict(), Field(gt=0, le=100)] = Field(
        3.0,
        description="rate at which a barrier is approached [1/s]: lower, and vehicles give way earlier",
    )
    share: Annotated[float, Strict(), Field(gt=0, le=1)] = Field(
        0.9, description="share of the vehicles' braking that barriers plan with [-]"
    )
    release: Annotated[float, Strict(), Field(ge=0.01, le=60)] = Field(
        0.5, description="time in which edges let go near a barrier, and take hold again [s]"
    )
    reference: Literal["path", "flow"] = Field(
        "path",
        description="path: vehicles are asked for what the laws ask; flow: what they ask is led round obstacles as a "
        "flow round balls",
    )
    sensing_range: Length | None = Field(
        None,
        description="distance of an agent's centre from an obstacle that moves within which all see it [m]; default: "
        "its motion is known in advance",
    )
    sensing_noise: LengthOrZero = Field(
        0.0, description="standard deviation of the place of an obstacle seen, along each axis [m]"
    )
    obstacle_acceleration: Annotated[float, Strict(), Field(ge=0, le=100)] = Field(
        0.0,
        description="acceleration of obstacles that is reckoned with [m/s^2]: in the Kalman filter, and less braking",
    )
    seed: Seed = Field(
        0, description="seed of the random numbers; the same seed gives the same sensing noise"
    )


class Agents(Part):
    """The vehicles of the fleet. After the check, each field has one entry per agent."""

    mass: Annotated[tuple[Mass, ...], number_or_list(MASS.least)] = Field(
        description="mass [kg], > 0: one number for all agents, or a list with one per agent; with vehicle, it is the "
        "vehicle's"
    )
    vehicle: Annotated[tuple[str, ...], NAME_OR_LIST] = Field(
        (),
        description="name of a table [vehicles.NAME], or a list with one name per agent; default: point masses that "
        "give any force at once",
    )
    position: Annotated[tuple[Vector, ...], Field(min_length=1)] = Field(
        description="initial position [x, y, z] of each agent [m], world axes ENU (z up); or a table with the "
        "shape in which the agents start, or the name of a file of points: CSV, NPY or PLY, relative to the mission "
        "file"
    )
    velocity: tuple[Velocity, ...] = Field(
        (), description="initial velocity of each agent [m/s]; default: at rest"
    )
    fixed: tuple[AgentNumber, ...] = Field(
        (), description="numbers of agents that never move; only with control 'open', solver 'pinv'"
    )
    radius: Annotated[tuple[LengthOrZero, ...], number_or_list(0)] = Field(
        (0.25,),
        description="radius of the sphere around an agent that must not touch anything [m]: a number or a list",
    )
    thrust_limit: Annotated[tuple[Limit, ...], number_or_list(FORCE.least)] = Field(
        (math.inf,),
        description="maximum thrust |f_u + f_C| [N], of input and constraint force together: a number or a list; "
        "default: unlimited",
    )
    saturate: Flag = Field(
        False,
        description="true: thrust is clipped at thrust_limit; false: the verdict compares it with thrust_limit",
    )

    @model_validator(mode="before")
    @classmethod
    def _spread(cls, data: Any) -> Any:
        """Repeat a single number for all agents, and let agents without velocities start at rest."""
        if not (isinstance(data, dict) and isinstance(data.get("position"), list | tuple)):
            return data
        n = len(data["position"])
        full = {"velocity": [(0.0, 0.0, 0.0)] * n, "radius": 0.25, "thrust_limit": math.inf} | data
        for key in full.keys() & {"mass", "radius", "thrust_limit"}:
            if not isinstance(full[key], list | tuple):
                full[key] = [full[key]] * n
        return full


class Constraint(Part):
    """The constraint force: feedback of the constraint c = L - d, and the solver for the multipliers."""

    alpha: Gain = Field(3.0, description="alpha [1/s], > 0; the feedback gain of dc/dt is 2 alpha")
    beta: Gain = Field(
        math.sqrt(12), description="beta [1/s], > 0; the feedback gain of c is beta^2"
    )
    gamma: Annotated[float, Strict(), of_either_sign(GAIN, 3)] = Field(
        8.0, description="feedback gain of the integral of c [1/s^3], >= 0, < 2 alpha beta^2"
    )
    stabilisation: Literal["pid", "none"] = Field(
        "pid",
        description="pid: feedback with alpha, beta, gamma; none: no feedback, so constraints drift",
    )
    solver: Literal["iterated", "spectral", "exact", "pinv"] = Field(
        "iterated",
        description="iterated: iterated Tikhonov; spectral: spectral damping, smaller forces at steps; exact: the "
        "paper's inverse; pinv: pseudo-inverse",
    )
    damping: Damping = Field(
        "auto",
        description="damping mu of the iterated solver [-], > 0; auto: 0.03, or in phases that start in their "
        "formation a quarter of its smallest non-zero eigenvalue w if that is less",
    )
    iterations: Annotated[int, Strict(), Field(ge=1, le=100)] = Field(
        3, description="number of iterations k of the iterated solver, 1 to 100"
    )
    threshold: Tolerance = Field(0.1, description="threshold s0 of the spectral solver [-], > 0")
    cutoff: Annotated[float, Strict(), Field(gt=0, lt=1)] = Field(
        1e-3,
        description="cut-off of the pinv solver relative to the largest eigenvalue w, in (0, 1); smaller eigenvalues "
        "fade out smoothly",
    )
    deformation_damping: Annotated[float, Strict(), from_zero(GAIN)] = Field(
        1.0, description="damping of deformation velocities while no slots are tracked [1/s], >= 0"
    )

    @property
    def settling_time(self) -> float | None:
        """Time [s] in which an error of a distance falls to 2 %; None if it never does, or oscillates too long."""
        if self.stabilisation == "none":
            return None
        try:
            return pid.settling_time(self.alpha, self.beta, self.gamma)
        except ValueError:
            return None


class Regulator(Part):
    """Weights of a linear quadratic regulator for a double integrator, the same on each axis."""

    horizon: Literal["finite", "infinite"] = Field(
        "finite", description="finite: arrival at a time, weighted by S; infinite: Q and R alone"
    )
    Q: Weights = Field((0.0, 0.0), description="weights [error, rate error], >= 0")
    R: Cost = Field(1.0, description="weight of the acceleration, > 0")
    S: Weights = Field((1e3, 1e2), description="weights at arrival [error, rate error], >= 0")


class Lqr(Regulator):
    """Regulator of the virtual body: its centre of mass and, in `lqr.attitude`, its attitude."""

    attitude: Regulator = Field(
        default_factory=Regulator.model_construct,
        description="regulator of the attitude; missing keys are those of lqr",
    )

    @model_validator(mode="before")
    @classmethod
    def _inherit(cls, data: Any) -> Any:
        if not (isinstance(data, dict) and isinstance(data.get("attitude", {}), dict)):
            return data
        own = {key: value for key, value in data.items() if key in Regulator.model_fields}
        return data | {"attitude": own | data.get("attitude", {})}


class Tracking(Part):
    """Infinite-horizon regulator by which each agent tracks its slot."""

    Q: Weights = Field(
        (4.0, 4.0), description="weights [position error, velocity error], the first > 0"
    )
    R: Cost = Field(1.0, description="weight of the acceleration, > 0")
    integral: Annotated[float, Strict(), from_zero(GAIN)] = Field(
        0.0,
        description="gain of the integral of the position error [1/s^3], >= 0; frozen while a vehicle saturates; only "
        "with [vehicles]",
    )
    drag_feedforward: Flag = Field(
        False,
        description="true: the drag expected at the desired velocity in still air is added to the force; only with "
        "[vehicles]",
    )


class Allocation(Part):
    """Control allocation: from the wrench on the virtual body to forces on the agents (control 'body')."""

    method: Literal["rigid", "pinv"] = Field(
        "rigid",
        description="rigid: the forces that move the agents as points of a rigid body; pinv: the paper's matrix H",
    )
    torque_split: Literal["equal", "inertia", "inertia+force"] = Field(
        "equal", description="only for method 'pinv': how the torque is divided among the agents"
    )


class IntegratorOptions(Part):
    """Tolerances of the adaptive integrator."""

    rtol: Annotated[float, Strict(), Field(gt=0, le=0.1)] = Field(
        1e-8, description="relative tolerance [-]"
    )
    atol: Tolerance = Field(1e-10, description="absolute tolerance [m, m/s]")
    atol_velocity: Tolerance | None = Field(
        None,
        description="absolute tolerance of velocities [m/s]; default: atol, in a large formation that of positions "
        "times beta",
    )
    atol_integral: Tolerance | None = Field(
        None,
        description="absolute tolerance of the integrals of c [m s]; default: atol, plus rtol times the distance if "
        "the solver is not dense",
    )
    atol_attitude: Tolerance | None = Field(
        None,
        description="absolute tolerance of the quaternion of the body frame [-]; default: atol",
    )


class BodyFrame(Part):
    """Attach the body frame at t = 0 with this attitude instead of when a formation is established."""

    roll_deg: Angle = Field(0.0, description="roll [deg], 3-2-1 Euler angles")
    pitch_deg: Angle = Field(0.0, description="pitch [deg]")
    yaw_deg: Angle = Field(0.0, description="yaw [deg]")


class Formation(Part):
    """A formation: its shape (named or as slots), its edges and their distances.

    The methods require a checked formation of `n` agents.
    """

    shape: str | None = Field(
        None,
        description=f"named shape: {', '.join(shapes.SHAPES)}",
        json_schema_extra={"enum": [*shapes.SHAPES]},
    )
    size: Size | None = Field(
        None, description="edge length of the shape [m]; for a cuboid also [x, y, z]"
    )
    slots: tuple[Vector, ...] | None = Field(
        None,
        description="instead of a shape: desired position of each agent in the body frame [m], or the name of a "
        "file of points: CSV, NPY or PLY, relative to the mission file and not outside its folder",
    )
    edges: Edges = Field(
        "complete",
        description="list of pairs of agents, counted from 1; 'complete': all pairs; 'neighbours': pairs within reach; "
        "'henneberg': each agent to three nearer to the centre; 'henneberg-multilevel': each agent to three before "
        "it, from coarse to fine; both have 3 N - 6 edges",
    )
    reach: Length = Field(
        graphs.REACH,
        description="maximum length of edges 'neighbours', in distances of nearest neighbours; 1.9 includes second "
        "neighbours",
    )
    distances: tuple[Length, ...] | None = Field(
        None, description="length of each edge [m]; default: those between the slots"
    )
    dimension: Literal[2, 3] | None = Field(
        None,
        description="dimension of the space in which the agents keep this formation; default: that of the mission",
    )
    agents: Annotated[int, Strict(), Field(ge=1, le=bounds.AGENTS)] | None = Field(
        None, description="number of vehicles in the shape, if the others rest; default: all"
    )
    rest: Rest | None = Field(
        None,
        description="where vehicles wait for which there are no slots, in the axes of the slots: a list of points [m]; "
        "'sides': left and right of the formation, along x, mirrored so that its middle stays the same",
    )
    tolerance: Length | None = Field(
        None, description="greatest error of a distance [m]; default: by tolerance_share"
    )
    tolerance_share: Share = Field(
        SHAPE_TOLERANCE, gt=0, description="the same, as a share of the shortest distance [-]"
    )
    colour: Colour | None = Field(
        None,
        description="light of the vehicles in this formation, '#rrggbb': one for all, or a list with one per slot; "
        "default: that of the file of slots if it has colours, else the light before. Vehicles that rest are dark. "
        "Replay, figures and the exports skyc and gltf show it",
    )

    def greatest_error(self, shortest: float) -> float:
        """Greatest error of a distance [m] of which the shortest intended one is given [m]."""
        return self.tolerance_share * shortest if self.tolerance is None else self.tolerance

    def edge_array(self, n: int) -> Ints:
        """Edges (m, 2), agents from 0, i < j."""
        if self.edges == "complete":
            return graphs.complete_graph(n)
        if isinstance(self.edges, str):
            slots = self.slot_array(n)
            assert slots is not None  # checked: there is a shape or slots
            if self.edges == "neighbours":
                return graphs.neighbours(slots, self.reach)
            return (
                graphs.henneberg(slots)
                if self.edges == "henneberg"
                else graphs.henneberg_multilevel(slots)
            )
        return np.sort(np.array(self.edges, dtype=np.int64).reshape(-1, 2) - 1, axis=1)

    @property
    def knows_slots(self) -> bool:
        """Whether the formation is given by a shape or slots, not by distances alone."""
        return self.shape is not None or self.slots is not None

    def slot_array(self, n: int) -> Floats | None:
        """Slots (n, 3) [m] about their geometric centre; None if the distances do not determine them."""
        if self.shape is not None and self.size is not None:
            return shapes.slots(self.shape, self.size, n)
        if self.slots is not None:
            return rigid_body.centred(self.slots)
        return distance_geometry.slots_from_distances(n, self.edge_array(n), self.distances or ())


class Geofence(Part):
    """A box that no agent may leave."""

    min: Vector = Field(description="lowest corner [x, y, z] [m]")
    max: Vector = Field(description="highest corner [x, y, z] [m]")


class Limits(Part):
    """Limits for each agent: the verdict checks the flight, and `check` the plan of a smooth mission."""

    speed: Speed | None = Field(None, description="maximum speed [m/s]")
    acceleration: Acceleration | None = Field(None, description="maximum acceleration [m/s^2]")
    horizontal_speed: Speed | None = Field(None, description="maximum speed over the ground [m/s]")
    vertical_speed: Speed | None = Field(None, description="maximum speed up and down [m/s]")
    horizontal_acceleration: Acceleration | None = Field(
        None, description="maximum horizontal acceleration [m/s^2]"
    )
    vertical_acceleration: Acceleration | None = Field(
        None, description="maximum acceleration up and down [m/s^2]"
    )
    jerk: Jerk | None = Field(
        None,
        description="maximum jerk of the reference [m/s^3]; kept by the plan of a smooth mission",
    )
    horizontal_jerk: Jerk | None = Field(
        None, description="maximum horizontal jerk of the reference [m/s^3]; kept like `jerk`"
    )
    vertical_jerk: Jerk | None = Field(
        None, description="maximum jerk of the reference up and down [m/s^3]; kept like `jerk`"
    )
    tilt_deg: Annotated[float, Strict(), Field(gt=0, lt=90)] | None = Field(
        None,
        description="maximum tilt of the thrust that the reference needs, from the vertical [deg]; kept by the plan of "
        "a smooth mission",
    )
    separation: LengthOrZero | None = Field(
        None, description="minimum separation of agents [m]: centre distance minus radii"
    )
    separation_altitude: Coordinate | None = Field(
        None,
        description="altitude z [m] from which on `separation` holds: two agents that are both below it, as on their "
        "pads, may be nearer, but not touch; default: it always holds",
    )
    separation_allowance: LengthOrZero = Field(
        0.1,
        description="how much nearer to each other than planned agents may come in flight [m]; judged where the plan "
        "has a certificate",
    )
    separation_below: LengthOrZero | None = Field(
        None,
        description="minimum separation from an agent straight below [m]: height minus radii (downwash)",
    )
    geofence: Geofence | None = Field(None, description="box that no agent may leave")
    saturation: Share = Field(
        0.01,
        description="maximum share of a phase in which a vehicle cannot give what is asked of it [-], 0 to 0.95",
    )
    tracking_error: Length | None = Field(
        None, description="maximum distance of a vehicle from the slot that it tracks [m]"
    )

    @property
    def separation_always(self) -> float | None:
        """Minimum separation at all altitudes [m]; None if there is none."""
        return self.separation if self.separation_altitude is None else None


class Gusts(Part):
    """Gusts: the velocity of the air at each agent in addition to the steady wind, stationary from the start."""

    model: Literal["first-order", "dryden"] = Field(
        description="first-order: one correlation time for all directions; dryden: spectra of MIL-F-8785C along the "
        "wind, across it and vertical"
    )
    intensity: PerAxis | None = Field(
        None,
        description="standard deviation [m/s]: a number, or [along the wind, across, vertical]; default: from altitude "
        "and wind speed",
    )
    time_scale: Time | None = Field(None, description="correlation time of first-order gusts [s]")
    length: Size | None = Field(
        None,
        description="scale length of Dryden gusts [m]: a number, or [along the wind, across, vertical]",
    )
    altitude: Annotated[float, Strict(), Field(ge=3.048, le=304.8)] | None = Field(
        None,
        description="instead of length: height above ground [m], 3.048 to 304.8, which determines the lengths by "
        "MIL-F-8785C",
    )
    airspeed: Speed | None = Field(
        None,
        description="speed at which Dryden gusts pass by [m/s]; default: wind speed",
    )
    correlation: Annotated[float, Strict(), Field(ge=0, le=1)] | None = Field(
        None, description="correlation of the gusts at any two agents [-], 0 to 1; default: 0"
    )
    correlation_length: Length | None = Field(
        None,
        description="instead of correlation: length [m] in correlation = exp(-distance / length), with the distances "
        "of slots in the first established formation",
    )
    seed: Seed = Field(
        0, description="seed of the random numbers; the same seed gives the same gusts"
    )


class Noise(Part):
    """Measurement of each vehicle's own state: normal, independent noise, sampled at a fixed rate, and its delay."""

    position: LengthOrZero = Field(
        0.0, description="standard deviation of each component of the measured position [m]"
    )
    velocity: Spread = Field(
        0.0, description="standard deviation of each component of the measured velocity [m/s]"
    )
    rate: Annotated[float, Strict(), Field(gt=0, le=1000)] = Field(
        50.0, description="measurements per second [Hz], at most 1000"
    )
    delay: Delay = Field(
        0.0, description="age of a measurement when the laws use it [s]; only with [vehicles]"
    )
    dropped: Share = Field(
        0.0, description="share of the measurements that are lost, 0 to 0.95; only with [vehicles]"
    )
    seed: Seed = Field(
        0, description="seed of the random numbers; the same seed gives the same noise"
    )


class LostLink(Part):
    """Loss of a link: from this time on, two vehicles know nothing of each other, and no edge joins them."""

    between: tuple[Whole, Whole] = Field(description="the two agents, counted from 1")
    time: Time = Field(description="mission time of the loss [s], > 0")


class Outage(Part):
    """A time without messages: between two vehicles, from and to one, or everywhere."""

    between: tuple[Whole, ...] = Field(
        (), description="one or two agents, counted from 1; default: all", max_length=2
    )
    start: Seconds = Field(description="mission time from which no message is sent [s]")
    end: Time = Field(description="mission time from which messages are sent again [s]")


class Network(Part):
    """How vehicles know each other: each computes its force from its own state and its neighbours' messages."""

    rate: Annotated[float, Strict(), Field(gt=0, le=1000)] = Field(
        50.0, description="broadcasts of each vehicle a second [Hz], at most 1000"
    )
    delay: Delay = Field(0.0, description="time from a broadcast to its arrival [s]")
    jitter: Delay = Field(
        0.0,
        description="greatest time by which a message is later than that [s]: each is by a share of its own, so that "
        "messages may overtake each other",
    )
    loss: Share = Field(0.0, description="share of the messages that a link loses, 0 to 0.95")
    burst: Annotated[float, Strict(), Field(ge=1, le=1000)] | None = Field(
        None,
        description="mean number of messages lost one after the other; default: losses are independent",
    )
    range: Length | None = Field(
        None, description="distance beyond which no message is heard [m]; default: none"
    )
    budget: Annotated[float, Strict(), Field(gt=0)] | None = Field(
        None,
        description="broadcasts a second in all that the medium carries [Hz]; vehicles then send less often; default: "
        "no limit",
    )
    silence: Time = Field(
        0.5, description="time without a message after which a vehicle lets go of an edge [s]"
    )
    seed: Seed = Field(
        0, description="seed of the random numbers; the same seed loses the same messages"
    )
    outages: tuple[Outage, ...] = Field(
        (),
        description="times without messages: `outages = [{ between = [1, 2], start = 10.0, end = 12.0 }]`",
    )
    lost: tuple[LostLink, ...] = Field(
        (),
        description="links lost for good during the flight: `lost = [{ between = [1, 2], time = 30.0 }]`",
    )

    def sent_rate(self, n: int) -> float:
        """Broadcasts of each of n vehicles a second [Hz] that the medium carries."""
        return self.rate if self.budget is None else min(self.rate, self.budget / n)


class Lost(Part):
    """Loss of a vehicle: from this time on it has neither thrust nor edges."""

    agent: Whole = Field(description="agent that is lost, counted from 1")
    time: Time = Field(description="mission time of the loss [s], > 0")


class Disturbances(Part):
    """Disturbances of the flight. Control laws and constraint law do not know them."""

    wind: Velocity = Field(
        (0.0, 0.0, 0.0),
        description="velocity of the steady wind [m/s]: the direction in which the air moves",
    )
    drag: PerAgent | None = Field(
        None,
        description="drag force per velocity relative to the air [N s/m]: a number or a list; default: 0.3 per kg of "
        "mass if there is wind or gusts, else 0",
    )
    mass_error: PerAgentError = Field(
        0.0,
        description="relative error of mass [-], > -1: a number or a list; true mass = mass (1 + mass_error), control "
        "laws use mass",
    )
    gusts: Gusts | None = Field(None, description="gusts: [disturbances.gusts]")
    noise: Noise | None = Field(None, description="measurement noise: [disturbances.noise]")
    downwash: Flag = Field(
        False,
        description="true: vehicles blow on those below them, as a turbulent jet; only with [vehicles]",
    )
    ground_effect: Flag = Field(
        False, description="true: rotors near the ground give more thrust; only with [vehicles]"
    )
    lost: tuple[Lost, ...] = Field(
        (), description="vehicles lost during the flight: `lost = [{ agent = 2, time = 30.0 }]`"
    )
    on_loss: Literal["continue", "hold", "land"] = Field(
        "continue",
        description="what the others do when the first vehicle or link is lost: continue: fly the mission on; hold: "
        "brake to a stop and hold the formation; land: brake to a stop and land straight down",
    )
    hold_until: Time | None = Field(
        None,
        description="mission time to which on_loss 'hold' holds [s]; default: the planned end of the mission",
    )
    landing_formation: str | None = Field(
        None,
        description="level formation that on_loss 'land' takes before the descent; default: the one that is held",
    )


class MissionHeader(Part):
    """Keys at the top of a mission file."""

    schema_version: Literal[1] = Field(description="version of this format: 1")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")] = Field(
        description="short name, used for the files of results: letters, digits, '.', '_', '-'"
    )
    title: Annotated[str, Field(pattern=r"^[^\r\n]*$")] = Field(
        "", description="title of the mission in one line"
    )
    source: str = Field("", description="table or figure of the paper that the mission reproduces")
    architecture: Literal["local", "body"] = Field(
        "local", description="local: each agent tracks its slot; body: a wrench on the virtual body"
    )
    formulation: Literal["inertial", "body"] = Field(
        "inertial",
        description="equations of motion: inertial: Newton's; body: the paper's in the body frame, which need fewer "
        "steps when many agents turn",
    )
    smoothness: Literal["lqr", "jerk"] = Field(
        "lqr",
        description="way of the virtual body: lqr: legs of the regulators of [lqr], as in the paper, between which the "
        "acceleration jumps; jerk: acceleration and jerk are continuous, [lqr] is not used",
    )
    assignment: Literal["given", "shortest", "safe", "each"] = Field(
        "given",
        description="assignment of agents to slots and their edges: given: agent 1 to slot 1 and so on; shortest: "
        "least sum of squared distances from the start to the first established formation; safe: most clearance on the "
        "paths there; each: as shortest, anew at each change of formation, without turning the shapes",
    )
    assignment_downwash: Annotated[float, Strict(), Field(ge=1, le=100)] = Field(
        1.0,
        description="with assignment 'each': heights count divided by this, so that vehicles that change places keep "
        "more of a distance above each other than beside",
    )
    gravity: Annotated[float, Strict(), from_zero(ACCELERATION)] = Field(
        9.81, description="gravity [m/s^2], >= 0"
    )
    output_step: Time = Field(0.05, description="time between samples of the result [s]")
    dimension: Literal[2, 3] = Field(
        3,
        description="dimension of the space in which the agents keep their formations, for `check`: 2: in a plane, "
        "where it judges rigidity and searches other shapes; no flight changes by it",
    )


class GeodeticOrigin(Part):
    """Place on the Earth of the mission's origin, for exports; x points east, y north and z up there."""

    latitude_deg: Annotated[float, Strict(), Field(gt=-90, lt=90)] = Field(
        description="latitude [deg], WGS 84"
    )
    longitude_deg: Annotated[float, Strict(), Field(ge=-180, le=180)] = Field(
        description="longitude [deg]"
    )
    altitude: Annotated[float, Strict(), Field(ge=-1000, le=20_000)] = Field(
        0.0, description="height of z = 0 above mean sea level [m]"
    )


class VehicleYaw(Part):
    """Yaw of each vehicle, which no force of a formation depends on."""

    kind: Literal["formation", "fixed", "along", "towards"] = Field(
        "formation",
        description="formation: the vehicles turn with the virtual body; fixed: they keep yaw_deg; along: they look "
        "along their way, and keep their heading while slow; towards: they look at a point",
    )
    yaw_deg: Angle = Field(0.0, description="yaw [deg] of kind 'fixed'")
    point: Vector | None = Field(None, description="the point [x, y, z] [m] of kind 'towards'")


class Contents(MissionHeader):
    """A whole mission file."""

    agents: Agents = Field(description="the vehicles: [agents]")
    vehicles: dict[str, Vehicle] = Field(
        default_factory=dict, description="models of vehicles by name: [vehicles.NAME]"
    )
    autopilot: Autopilot = Field(
        default_factory=Autopilot.model_construct,
        description="sampled control on board: [autopilot]",
    )
    avoidance: Avoidance | None = Field(
        None, description="barriers and guard in flight: [avoidance]"
    )
    constraint: Constraint = Field(
        default_factory=Constraint.model_construct, description="the constraint force: [constraint]"
    )
    lqr: Lqr = Field(
        default_factory=Lqr.model_construct, description="regulator of the virtual body: [lqr]"
    )
    tracking: Tracking = Field(
        default_factory=Tracking.model_construct, description="regulator of each agent: [tracking]"
    )
    allocation: Allocation = Field(
        default_factory=Allocation.model_construct,
        description="from wrench to forces on agents: [allocation]",
    )
    integrator: IntegratorOptions = Field(
        default_factory=IntegratorOptions.model_construct,
        description="tolerances of the integrator: [integrator]",
    )
    body_frame: BodyFrame | None = Field(
        None, description="attitude of the body frame at t = 0: [body_frame]"
    )
    formations: dict[str, Formation] = Field(
        default_factory=dict, description="formations by name: [formations.NAME]"
    )
    obstacles: tuple[Obstacle, ...] = Field((), description="obstacles: [[obstacles]]")
    limits: Limits = Field(
        default_factory=Limits.model_construct,
        description="limits that the verdict checks: [limits]",
    )
    yaw: VehicleYaw = Field(
        default_factory=VehicleYaw.model_construct, description="yaw of each vehicle: [yaw]"
    )
    geodetic_origin: GeodeticOrigin | None = Field(
        None, description="place of the origin on the Earth, for exports: [geodetic_origin]"
    )
    network: Network | None = Field(
        None,
        description="messages between vehicles, only with [vehicles]: [network]; default: one law knows all states",
    )
    disturbances: Disturbances | None = Field(
        None, description="wind, gusts, noise, mass errors, lost vehicles: [disturbances]"
    )
    phases: Annotated[tuple[Phase, ...], Field(min_length=1)] = Field(
        description="phases of the flight, in order: [[phases]]"
    )
