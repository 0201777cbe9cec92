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
from rigidfleet.mission import bounds, values
from rigidfleet.mission.fences import Fence, People
from rigidfleet.mission.kinds import Phase
from rigidfleet.mission.obstacles import Obstacle
from rigidfleet.mission.values import Part, key, required_key
from rigidfleet.typing import Floats, Ints

#: Default drag coefficient of a vehicle per mass [1/s]. At the speeds of formation flight, rotor drag dominates, which
#: is linear in the speed. Identified from flights: 0.4 to 0.5 /s along two axes of a quadrotor (Faessler, Franchi,
#: Scaramuzza, Robotics and Automation Letters 3, 2018). A vehicle with more mass per rotor has less.
DRAG = 0.3
_SHAPE = f"named shape: {', '.join(shapes.SHAPES)}"
_SHAPE_NAMES: dict[str, Any] = {"enum": [*shapes.SHAPES]}


class Start(Part):
    """Start positions of the agents on the slots of a named shape, in their order."""

    shape: str = required_key(_SHAPE, json_schema_extra=_SHAPE_NAMES)
    size: values.Size = required_key("edge length of the shape [m], or its three sizes")
    count: values.AgentNumber = required_key("number of agents")
    centre: values.Vector = key("centre of the shape [x, y, z] [m]", (0.0, 0.0, 0.0))

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

    model: Literal["point", "paper", "px4-sih", "hummingbird", "crazyflie", "x500"] = required_key(
        "point: a point mass that gives any force at once; the others are quadrotors: paper: the paper's, "
        "1 kg with four rotors of 5.9 N; px4-sih: PX4's simulation in hardware; hummingbird: AscTec Hummingbird; "
        "crazyflie: Crazyflie 2; x500: Holybro X500"
    )
    mass: values.Mass | None = key("mass [kg]; required for a point")
    inertia: values.Inertia | None = key(
        "moments of inertia about the body's axes [x, y, z] [kg m^2]"
    )
    arm: values.Length | None = key(
        "distance of each rotor from the centre of mass [m]; rotors form an X"
    )
    thrust_coefficient: values.Small | None = key(
        "k_f [N s^2/rad^2]: a rotor's thrust is k_f times the square of its speed"
    )
    torque_coefficient: values.Small | None = key(
        "k_m [N m s^2/rad^2]: its drag torque is k_m times the square of its speed"
    )
    rotor_speed: values.RotorSpeeds | None = key("[least, greatest] speed of a rotor [rad/s]")
    motor_time: values.MotorTimes | None = key(
        "time constants of the motors [s]: [up, down], how quickly rotors speed up and slow down"
    )
    rotor_drag: values.Coefficient | None = key(
        "k_d [kg/rad]: drag of a rotor per its speed and the air's speed across its axis"
    )
    rotor_inflow: values.Coefficient | None = key("k_z [kg/rad]: the same along its axis")
    rotor_lift: values.Coefficient | None = key(
        "k_h [kg/m]: additional thrust of a rotor per square of the air's speed across it"
    )
    body_drag: values.BodyDrag | None = key(
        "drag of the body per square of the air's speed [x, y, z] [N s^2/m^2]"
    )
    rotor_radius: values.Length | None = key(
        "radius of a rotor [m], for downwash and ground effect"
    )
    attitude_gains: values.AttitudeGains | None = key(
        "[k_R, k_omega] of the attitude control per moment of inertia [1/s^2, 1/s]"
    )
    tilt_limit_deg: values.Tilt | None = key(
        "maximum tilt that the attitude control commands [deg]"
    )
    thrust_limit: values.Limit | None = key(
        "maximum thrust [N], only for a point; default: unlimited"
    )
    drag: values.Weight | None = key(
        "drag force per velocity relative to the air [N s/m], only for a point; default: 0"
    )


class Autopilot(Part):
    """Sampled control on board: how often each vehicle's computer acts. Only with [vehicles]."""

    rate: values.Rate = key(
        "rate of the attitude control [Hz]; commands are held in between", 500.0
    )
    formation_rate: values.Rate = key(
        "rate of the formation's laws [Hz], which give each vehicle its force; rate is a multiple of it",
        100.0,
    )
    delay_compensation: values.Flag = key(
        "true: measurements carry their time, and are compared with the reference of that time, while "
        "slots are tracked; false: with the reference of now",
        True,
    )
    step: Annotated[float, Strict(), Field(ge=1e-5, le=0.01)] = key(
        "longest step of the integrator, a fourth-order Runge-Kutta method [s]", 0.002
    )


class Avoidance(Part):
    """Avoidance in flight, at the rate of the formation's laws; see docs/avoidance.md. Only with [vehicles]."""

    guard: values.Flag = key(
        "true: a vehicle does only what leaves all of them able to brake in time", True
    )
    barrier: values.Flag = key(
        "true: barriers change accelerations early and as little as possible, and edges of a formation let "
        "go near them",
        True,
    )
    clock: values.Flag = key(
        "true: a formation waits on its path while an obstacle that moves passes", True
    )
    patience: Annotated[float, Strict(), Field(ge=0, le=3600)] = key(
        "time by which a phase may end later because its formation waits [s]", 30.0
    )
    body: values.Flag = key(
        "true: a formation is steered round obstacles that move as one body, before single agents give "
        "way",
        True,
    )
    separation: values.LengthOrZero | None = key(
        "separation of agents to keep [m]; default: that of [limits], or 0"
    )
    clearance: values.LengthOrZero = key(
        "distance of an agent's surface from obstacles to keep [m]", 0.0
    )
    margin: values.LengthOrZero | None = key(
        "by which each agent is taken to be larger [m]; default: three times the noise of positions, and "
        "0.02 m for a quadrotor"
    )
    rate: Annotated[float, Strict(), Field(gt=0, le=100)] = key(
        "rate at which a barrier is approached [1/s]: lower, and vehicles give way earlier", 3.0
    )
    share: Annotated[float, Strict(), Field(gt=0, le=1)] = key(
        "share of the vehicles' braking that barriers plan with [-]", 0.9
    )
    release: Annotated[float, Strict(), Field(ge=0.01, le=60)] = key(
        "time in which edges let go near a barrier, and take hold again [s]", 0.5
    )
    reference: Literal["path", "flow"] = key(
        "path: vehicles are asked for what the laws ask; flow: what they ask is led round obstacles as a "
        "flow round balls",
        "path",
    )
    sensing_range: values.Length | None = key(
        "distance of an agent's centre from an obstacle that moves within which all see it [m]; default: "
        "its motion is known in advance"
    )
    sensing_noise: values.LengthOrZero = key(
        "standard deviation of the place of an obstacle seen, along each axis [m]", 0.0
    )
    obstacle_acceleration: Annotated[float, Strict(), Field(ge=0, le=100)] = key(
        "acceleration of obstacles that is reckoned with [m/s^2]: in the Kalman filter, and less braking",
        0.0,
    )
    seed: values.Seed = key(
        "seed of the random numbers; the same seed gives the same sensing noise", 0
    )


class Agents(Part):
    """The vehicles of the fleet. After the check, each field has one entry per agent."""

    mass: Annotated[tuple[values.Mass, ...], values.number_or_list(bounds.MASS.least)] = (
        required_key(
            "mass [kg], > 0: one number for all agents, or a list with one per agent; with vehicle, it is the "
            "vehicle's"
        )
    )
    vehicle: Annotated[tuple[str, ...], values.NAME_OR_LIST] = key(
        "name of a table [vehicles.NAME], or a list with one name per agent; default: point masses that "
        "give any force at once",
        (),
    )
    position: Annotated[tuple[values.Vector, ...], Field(min_length=1)] = required_key(
        "initial position [x, y, z] of each agent [m], world axes ENU (z up); or a table with the "
        "shape in which the agents start, or the name of a file of points: CSV, NPY or PLY, relative to the mission "
        "file"
    )
    velocity: tuple[values.Velocity, ...] = key(
        "initial velocity of each agent [m/s]; default: at rest", ()
    )
    fixed: tuple[values.AgentNumber, ...] = key(
        "agents that never move; only with control 'open', solver 'pinv' or 'spectral'", ()
    )
    radius: Annotated[tuple[values.LengthOrZero, ...], values.number_or_list(0)] = key(
        "radius of the sphere around an agent that must not touch anything [m]: a number or a list",
        (0.25,),
    )
    thrust_limit: Annotated[tuple[values.Limit, ...], values.number_or_list(bounds.FORCE.least)] = (
        key(
            "maximum thrust |f_u + f_C| [N], of input and constraint force together: a number or a list; "
            "default: unlimited",
            (math.inf,),
        )
    )
    saturate: values.Flag = key(
        "true: thrust is clipped at thrust_limit; false: the verdict compares it with thrust_limit",
        False,
    )

    @model_validator(mode="before")
    @classmethod
    def _repeat_for_agents(cls, data: Any) -> Any:
        """Repeat a single number for all agents, and let agents without velocities start at rest."""
        if not (isinstance(data, dict) and isinstance(data.get("position"), list | tuple)):
            return data
        n = len(data["position"])
        full = {"velocity": [(0.0, 0.0, 0.0)] * n, "radius": 0.25, "thrust_limit": math.inf} | data
        for name in full.keys() & {"mass", "radius", "thrust_limit"}:
            if not isinstance(full[name], list | tuple):
                full[name] = [full[name]] * n
        return full


class Constraint(Part):
    """The constraint force: feedback of the constraint c = L - d, and the solver for the multipliers."""

    alpha: values.Gain = key("alpha [1/s], > 0; the feedback gain of dc/dt is 2 alpha", 3.0)
    beta: values.Gain = key("beta [1/s], > 0; the feedback gain of c is beta^2", math.sqrt(12))
    gamma: Annotated[float, Strict(), values.signed_number_field(bounds.GAIN, 3)] = key(
        "feedback gain of the integral of c [1/s^3], >= 0, < 2 alpha beta^2", 8.0
    )
    stabilisation: Literal["pid", "none"] = key(
        "pid: feedback with alpha, beta, gamma; none: no feedback, so constraints drift", "pid"
    )
    solver: Literal["iterated", "spectral", "exact", "pinv"] = key(
        "iterated: iterated Tikhonov; spectral: spectral damping, smaller forces at steps; exact: the "
        "paper's inverse; pinv: pseudo-inverse",
        "iterated",
    )
    damping: values.Damping = key(
        "damping mu of the iterated solver [-], > 0; auto: 0.03, or in phases that start in their "
        "formation a quarter of its smallest non-zero eigenvalue w if that is less",
        "auto",
    )
    iterations: Annotated[int, Strict(), Field(ge=1, le=100)] = key(
        "number of iterations k of the iterated solver, 1 to 100", 3
    )
    threshold: values.Tolerance = key("threshold s0 of the spectral solver [-], > 0", 0.1)
    cutoff: Annotated[float, Strict(), Field(gt=0, lt=1)] = key(
        "cut-off of the pinv solver relative to the largest eigenvalue w, in (0, 1); smaller eigenvalues "
        "fade out smoothly",
        1e-3,
    )
    deformation_damping: Annotated[
        float, Strict(), values.nonnegative_number_field(bounds.GAIN)
    ] = key("damping of deformation velocities while no slots are tracked [1/s], >= 0", 1.0)

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

    horizon: Literal["finite", "infinite"] = key(
        "finite: arrival at a time, weighted by S; infinite: Q and R alone", "finite"
    )
    Q: values.Weights = key("weights [error, rate error], >= 0", (0.0, 0.0))
    R: values.Cost = key("weight of the acceleration, > 0", 1.0)
    S: values.Weights = key("weights at arrival [error, rate error], >= 0", (1e3, 1e2))


class Lqr(Regulator):
    """Regulator of the virtual body: its centre of mass and, in `lqr.attitude`, its attitude."""

    attitude: Regulator = key(
        "regulator of the attitude; missing keys are those of lqr",
        Regulator.model_construct,
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_attitude_weights(cls, data: Any) -> Any:
        if not (isinstance(data, dict) and isinstance(data.get("attitude", {}), dict)):
            return data
        own = {key: value for key, value in data.items() if key in Regulator.model_fields}
        return data | {"attitude": own | data.get("attitude", {})}


class Tracking(Part):
    """Infinite-horizon regulator by which each agent tracks its slot."""

    Q: values.Weights = key("weights [position error, velocity error], the first > 0", (4.0, 4.0))
    R: values.Cost = key("weight of the acceleration, > 0", 1.0)
    integral: Annotated[float, Strict(), values.nonnegative_number_field(bounds.GAIN)] = key(
        "gain of the integral of the position error [1/s^3], >= 0; frozen while a vehicle saturates; only "
        "with [vehicles]",
        0.0,
    )
    drag_feedforward: values.Flag = key(
        "true: the drag expected at the desired velocity in still air is added to the force; only with "
        "[vehicles]",
        False,
    )


class Allocation(Part):
    """Control allocation: from the wrench on the virtual body to forces on the agents (control 'body')."""

    method: Literal["rigid", "pinv"] = key(
        "rigid: the forces that move the agents as points of a rigid body; pinv: the paper's matrix H",
        "rigid",
    )
    torque_split: Literal["equal", "inertia", "inertia+force"] = key(
        "only for method 'pinv': how the torque is divided among the agents", "equal"
    )


class IntegratorOptions(Part):
    """Tolerances of the adaptive integrator."""

    rtol: Annotated[float, Strict(), Field(gt=0, le=0.1)] = key("relative tolerance [-]", 1e-8)
    atol: values.Tolerance = key("absolute tolerance [m, m/s]", 1e-10)
    atol_velocity: values.Tolerance | None = key(
        "absolute tolerance of velocities [m/s]; default: atol, in a large formation that of positions "
        "times beta"
    )
    atol_integral: values.Tolerance | None = key(
        "absolute tolerance of the integrals of c [m s]; default: atol, plus rtol times the distance if "
        "the solver is not dense"
    )
    atol_attitude: values.Tolerance | None = key(
        "absolute tolerance of the quaternion of the body frame [-]; default: atol"
    )


class BodyFrame(Part):
    """Attach the body frame at t = 0 with this attitude instead of when a formation is established."""

    roll_deg: values.Angle = key("roll [deg], 3-2-1 Euler angles", 0.0)
    pitch_deg: values.Angle = key("pitch [deg]", 0.0)
    yaw_deg: values.Angle = key("yaw [deg]", 0.0)


class Formation(Part):
    """A formation: its shape (named or as slots), its edges and their distances.

    The methods require a checked formation of `n` agents.
    """

    shape: str | None = key(_SHAPE, json_schema_extra=_SHAPE_NAMES)
    size: values.Size | None = key("edge length of the shape [m]; for a cuboid also [x, y, z]")
    slots: tuple[values.Vector, ...] | None = key(
        "instead of a shape: desired position of each agent in the body frame [m], or the name of a "
        "file of points: CSV, NPY or PLY, relative to the mission file and not outside its folder"
    )
    edges: values.Edges = key(
        "list of pairs of agents, counted from 1; 'complete': all pairs; 'neighbours': pairs within reach; "
        "'henneberg': each agent to three nearer to the centre; 'henneberg-multilevel': each agent to three before "
        "it, from coarse to fine; both have 3 N - 6 edges",
        "complete",
    )
    reach: values.Length = key(
        "maximum length of edges 'neighbours', in distances of nearest neighbours; 1.9 includes second "
        "neighbours",
        graphs.REACH,
    )
    distances: tuple[values.Length, ...] | None = key(
        "length of each edge [m]; default: those between the slots"
    )
    dimension: Literal[2, 3] | None = key(
        "dimension of the space in which the agents keep this formation; default: that of the mission"
    )
    agents: values.AgentNumber | None = key(
        "number of vehicles in the shape, if the others rest; default: all"
    )
    rest: values.Rest | None = key(
        "where vehicles wait for which there are no slots, in the axes of the slots: a list of points [m]; "
        "'sides': left and right of the formation, along x, mirrored so that its middle stays the same"
    )
    tolerance: values.Length | None = key(
        "greatest error of a distance [m]; default: by tolerance_share"
    )
    tolerance_share: values.Share = key(
        "the same, as a share of the shortest distance [-]", SHAPE_TOLERANCE, gt=0
    )
    colour: values.Colour | None = key(
        "light of the vehicles in this formation, '#rrggbb': one for all, or a list with one per slot; "
        "default: that of the file of slots if it has colours, else the light before. Vehicles that rest are dark. "
        "Replay, figures and the exports skyc and gltf show it"
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
            return graphs.GRAPHS[self.edges](slots, self.reach)
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
        return distance_geometry.slots_of_all_distances(n, self.edge_array(n), self.distances or ())


class Geofence(Part):
    """A box that no agent may leave."""

    min: values.Vector = required_key("lowest corner [x, y, z] [m]")
    max: values.Vector = required_key("highest corner [x, y, z] [m]")


class Limits(Part):
    """Limits for each agent: the verdict checks the flight, and `check` the plan of a smooth mission."""

    speed: values.Speed | None = key("maximum speed [m/s]")
    acceleration: values.Acceleration | None = key("maximum acceleration [m/s^2]")
    horizontal_speed: values.Speed | None = key("maximum speed over the ground [m/s]")
    vertical_speed: values.Speed | None = key("maximum speed up and down [m/s]")
    horizontal_acceleration: values.Acceleration | None = key(
        "maximum horizontal acceleration [m/s^2]"
    )
    vertical_acceleration: values.Acceleration | None = key(
        "maximum acceleration up and down [m/s^2]"
    )
    jerk: values.Jerk | None = key(
        "maximum jerk of the reference [m/s^3]; kept by the plan of a smooth mission"
    )
    horizontal_jerk: values.Jerk | None = key(
        "maximum horizontal jerk of the reference [m/s^3]; kept like `jerk`"
    )
    vertical_jerk: values.Jerk | None = key(
        "maximum jerk of the reference up and down [m/s^3]; kept like `jerk`"
    )
    tilt_deg: values.Tilt | None = key(
        "maximum tilt of the thrust that the reference needs, from the vertical [deg]; kept by the plan of "
        "a smooth mission"
    )
    separation: values.LengthOrZero | None = key(
        "minimum separation of agents [m]: centre distance minus radii"
    )
    separation_altitude: values.Coordinate | None = key(
        "altitude z [m] from which on `separation` holds: two agents that are both below it, as on their "
        "pads, may be nearer, but not touch; default: it always holds"
    )
    separation_allowance: values.LengthOrZero = key(
        "how much nearer to each other than planned agents may come in flight [m]; judged where the plan "
        "has a certificate",
        0.1,
    )
    separation_below: values.LengthOrZero | None = key(
        "minimum separation from an agent straight below [m]: height minus radii (downwash)"
    )
    geofence: Geofence | None = key("box that no agent may leave")
    people: values.LengthOrZero = key(
        "least distance, as seen from above, at which a vehicle that fails falls past people [m]: less its radius",
        0.0,
    )
    saturation: values.Share = key(
        "maximum share of a phase in which a vehicle cannot give what is asked of it [-], 0 to 0.95",
        0.01,
    )
    tracking_error: values.Length | None = key(
        "maximum distance of a vehicle from the slot that it tracks [m]"
    )

    @property
    def separation_at_all_heights(self) -> float | None:
        """Minimum separation at all altitudes [m]; None if there is none."""
        return self.separation if self.separation_altitude is None else None


class Gusts(Part):
    """Gusts: the velocity of the air at each agent in addition to the steady wind, stationary from the start."""

    model: Literal["first-order", "dryden"] = required_key(
        "first-order: one correlation time for all directions; dryden: spectra of MIL-F-8785C along the "
        "wind, across it and vertical"
    )
    intensity: values.PerAxis | None = key(
        "standard deviation [m/s]: a number, or [along the wind, across, vertical]; default: from altitude "
        "and wind speed"
    )
    time_scale: values.Time | None = key("correlation time of first-order gusts [s]")
    length: values.Size | None = key(
        "scale length of Dryden gusts [m]: a number, or [along the wind, across, vertical]"
    )
    altitude: Annotated[float, Strict(), Field(ge=3.048, le=304.8)] | None = key(
        "instead of length: height above ground [m], 3.048 to 304.8, which determines the lengths by "
        "MIL-F-8785C"
    )
    airspeed: values.Speed | None = key(
        "speed at which Dryden gusts pass by [m/s]; default: wind speed"
    )
    correlation: Annotated[float, Strict(), Field(ge=0, le=1)] | None = key(
        "correlation of the gusts at any two agents [-], 0 to 1; default: 0"
    )
    correlation_length: values.Length | None = key(
        "instead of correlation: length [m] in correlation = exp(-distance / length), with the distances "
        "of slots in the first established formation"
    )
    seed: values.Seed = key("seed of the random numbers; the same seed gives the same gusts", 0)


class Noise(Part):
    """Measurement of each vehicle's own state: normal, independent noise, sampled at a fixed rate, and its delay."""

    position: values.LengthOrZero = key(
        "standard deviation of each component of the measured position [m]", 0.0
    )
    velocity: values.Spread = key(
        "standard deviation of each component of the measured velocity [m/s]", 0.0
    )
    rate: values.Frequency = key("measurements per second [Hz], at most 1000", 50.0)
    delay: values.Delay = key(
        "age of a measurement when the laws use it [s]; only with [vehicles]", 0.0
    )
    dropped: values.Share = key(
        "share of the measurements that are lost, 0 to 0.95; only with [vehicles]", 0.0
    )
    seed: values.Seed = key("seed of the random numbers; the same seed gives the same noise", 0)


class LostLink(Part):
    """Loss of a link: from this time on, two vehicles know nothing of each other, and no edge joins them."""

    between: tuple[values.Whole, values.Whole] = required_key("the two agents, counted from 1")
    time: values.Time = required_key("mission time of the loss [s], > 0")


class Outage(Part):
    """A time without messages: between two vehicles, from and to one, or everywhere."""

    between: tuple[values.Whole, ...] = key(
        "one or two agents, counted from 1; default: all", (), max_length=2
    )
    start: values.Seconds = required_key("mission time from which no message is sent [s]")
    end: values.Time = required_key("mission time from which messages are sent again [s]")


class Clocks(Part):
    """Clocks of the vehicles, by which each flies the plan by itself, and how they keep together."""

    late: values.PerAgentDelay = key(
        "time by which clocks start late [s], at most 10: a list, or the greatest, of which each vehicle has a share "
        "drawn by the seed",
        0.0,
    )
    drift: values.PerAgentDrift = key(
        "drift of the clocks [ppm]: a list, or the greatest, of which each vehicle has a share from -1 to 1 drawn by "
        "the seed",
        0.0,
    )
    consensus: Annotated[float, Strict(), Field(ge=0, le=100)] = key(
        "gain with which a clock follows those of its neighbours [1/s]; 0: they never meet", 0.0
    )
    wait: values.Length | None = key(
        "distance of a vehicle from its slot at which all clocks stand still, that hear of it [m]; from half of it on "
        "they slow down; default: nobody waits"
    )


class Network(Part):
    """How vehicles know each other: each computes its force from its own state and its neighbours' messages."""

    rate: values.Frequency = key("broadcasts of each vehicle a second [Hz], at most 1000", 50.0)
    delay: values.Delay = key("time from a broadcast to its arrival [s]", 0.0)
    jitter: values.Delay = key(
        "greatest time by which a message is later than that [s]: each is by a share of its own, so that "
        "messages may overtake each other",
        0.0,
    )
    loss: values.Share = key("share of the messages that a link loses, 0 to 0.95", 0.0)
    burst: Annotated[float, Strict(), Field(ge=1, le=1000)] | None = key(
        "mean number of messages lost one after the other; default: losses are independent"
    )
    range: values.Length | None = key(
        "distance beyond which no message is heard [m]; default: none"
    )
    budget: Annotated[float, Strict(), Field(gt=0, le=1e9)] | None = key(
        "broadcasts a second in all that the medium carries [Hz]; vehicles then send less often; default: "
        "no limit"
    )
    silence: values.Time = key(
        "time without a message after which a vehicle lets go of an edge [s]", 0.5
    )
    event: values.Length | None = key(
        "distance [m] by which neighbours guess a vehicle wrongly before it sends, or before `silence` would run out; "
        "default: it sends each time"
    )
    seed: values.Seed = key("seed of the random numbers; the same seed loses the same messages", 0)
    outages: tuple[Outage, ...] = key(
        "times without messages: `outages = [{ between = [1, 2], start = 10.0, end = 12.0 }]`", ()
    )
    clocks: Clocks | None = key("clocks of the vehicles: [network.clocks]; default: one for all")
    lost: tuple[LostLink, ...] = key(
        "links lost for good during the flight: `lost = [{ between = [1, 2], time = 30.0 }]`", ()
    )

    def broadcast_rate(self, n: int) -> float:
        """Broadcasts of each of n vehicles a second [Hz] that the medium carries."""
        return self.rate if self.budget is None else min(self.rate, self.budget / n)


class Lost(Part):
    """Loss of a vehicle: from this time on it has neither thrust nor edges."""

    agent: values.Whole = required_key("agent that is lost, counted from 1")
    time: values.Time = required_key("mission time of the loss [s], > 0")


class Stuck(Part):
    """A vehicle that does not follow its slot for some time: it holds its place."""

    agent: values.Whole = required_key("agent that is stuck, counted from 1")
    time: values.Seconds = required_key("mission time from which on it is [s]")
    duration: values.Time = required_key("for how long [s]")


class Disturbances(Part):
    """Disturbances of the flight. Control laws and constraint law do not know them."""

    wind: values.Velocity = key(
        "velocity of the steady wind [m/s]: the direction in which the air moves", (0.0, 0.0, 0.0)
    )
    drag: values.PerAgent | None = key(
        "drag force per velocity relative to the air [N s/m]: a number or a list; default: 0.3 per kg of "
        "mass if there is wind or gusts, else 0"
    )
    mass_error: values.PerAgentError = key(
        "relative error of mass [-], > -1: a number or a list; true mass = mass (1 + mass_error), control "
        "laws use mass",
        0.0,
    )
    gusts: Gusts | None = key("gusts: [disturbances.gusts]")
    noise: Noise | None = key("measurement noise: [disturbances.noise]")
    downwash: values.Flag = key(
        "true: vehicles blow on those below them, as a turbulent jet; only with [vehicles]", False
    )
    ground_effect: values.Flag = key(
        "true: rotors near the ground give more thrust; only with [vehicles]", False
    )
    lost: tuple[Lost, ...] = key(
        "vehicles lost during the flight: `lost = [{ agent = 2, time = 30.0 }]`", ()
    )
    stuck: tuple[Stuck, ...] = key(
        "vehicles that hold their place for some time, only with [network]: `stuck = [{ agent = 2, time = 30.0, "
        "duration = 5.0 }]`",
        (),
    )
    on_loss: Literal["continue", "hold", "land", "abort"] = key(
        "what the others do when the first vehicle or link is lost: continue: fly the mission on; hold: "
        "brake to a stop and hold the formation; land: brake to a stop and land straight down; abort: go home by "
        "[abort]",
        "continue",
    )
    hold_until: values.Time | None = key(
        "mission time to which on_loss 'hold' holds [s]; default: the planned end of the mission"
    )
    landing_formation: str | None = key(
        "level formation that on_loss 'land' takes before the descent; default: the one that is held"
    )


class Aborting(Part):
    """How the flight is aborted, at any time: `check --abort` plans it, `run --abort-at` flies it."""

    at: values.Seconds | None = key("mission time at which an abort is ordered [s]; default: never")
    step: values.Time = key("time between the aborts that `check --abort` plans [s]", 1.0)
    reaction: Annotated[float, Strict(), Field(ge=0, le=60)] = key(
        "time after which all vehicles have the order, or notice a loss, and act at once [s]", 0.5
    )
    to: Literal["any", "own"] = key(
        "any: to any landing place, by the least sum of squares; own: each to its own, straight or by levels one above "
        "the other, or back along the plan. Places are those of the start, or a grid below if that is in the air",
        "any",
    )
    agents: tuple[values.AgentNumber, ...] = key(
        "numbers of the vehicles that go home, as soon as they come near no other one; the others fly the mission on. "
        "Default: all go home",
        (),
    )


class MissionHeader(Part):
    """Keys at the top of a mission file."""

    schema_version: Literal[1] = required_key("version of this format: 1")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")] = required_key(
        "short name, used for the files of results: letters, digits, '.', '_', '-'"
    )
    title: Annotated[str, Field(pattern=r"^[^\r\n]*$")] = key(
        "title of the mission in one line", ""
    )
    source: str = key("table or figure of the paper that the mission reproduces", "")
    architecture: Literal["local", "body"] = key(
        "local: each agent tracks its slot; body: a wrench on the virtual body", "local"
    )
    formulation: Literal["inertial", "body"] = key(
        "equations of motion: inertial: Newton's; body: the paper's in the body frame, which need fewer "
        "steps when many agents turn",
        "inertial",
    )
    smoothness: Literal["lqr", "jerk"] = key(
        "way of the virtual body: lqr: legs of the regulators of [lqr], as in the paper, between which the "
        "acceleration jumps; jerk: acceleration and jerk are continuous, [lqr] is not used",
        "lqr",
    )
    assignment: Literal["given", "shortest", "safe", "each"] = key(
        "assignment of agents to slots and their edges: given: agent 1 to slot 1 and so on; shortest: "
        "least sum of squared distances from the start to the first established formation; safe: most clearance on the "
        "paths there; each: as shortest, anew at each change of formation, without turning the shapes",
        "given",
    )
    assignment_downwash: Annotated[float, Strict(), Field(ge=1, le=100)] = key(
        "with assignment 'each': heights count divided by this, so that vehicles that change places keep "
        "more of a distance above each other than beside",
        1.0,
    )
    gravity: Annotated[float, Strict(), values.nonnegative_number_field(bounds.ACCELERATION)] = key(
        "gravity [m/s^2], >= 0", 9.81
    )
    output_step: values.Time = key("time between samples of the result [s]", 0.05)
    dimension: Literal[2, 3] = key(
        "dimension of the space in which the agents keep their formations, for `check`: 2: in a plane, "
        "where it judges rigidity and searches other shapes; no flight changes by it",
        3,
    )


class GeodeticOrigin(Part):
    """Place on the Earth of the mission's origin, for exports; x points east, y north and z up there."""

    latitude_deg: Annotated[float, Strict(), Field(gt=-90, lt=90)] = required_key(
        "latitude [deg], WGS 84"
    )
    longitude_deg: values.Longitude = required_key("longitude [deg]")
    altitude: Annotated[float, Strict(), Field(ge=-1000, le=20_000)] = key(
        "height of z = 0 above mean sea level [m]", 0.0
    )

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """Latitude, longitude [deg] and height [m]."""
        return self.latitude_deg, self.longitude_deg, self.altitude


class VehicleYaw(Part):
    """Yaw of each vehicle, which no force of a formation depends on."""

    kind: Literal["formation", "fixed", "along", "towards"] = key(
        "formation: the vehicles turn with the virtual body; fixed: they keep yaw_deg; along: they look "
        "along their way, and keep their heading while slow; towards: they look at a point",
        "formation",
    )
    yaw_deg: values.Angle = key("yaw [deg] of kind 'fixed'", 0.0)
    point: values.Vector | None = key("the point [x, y, z] [m] of kind 'towards'")


class Contents(MissionHeader):
    """A whole mission file."""

    agents: Agents = required_key("the vehicles: [agents]")
    vehicles: dict[str, Vehicle] = key("models of vehicles by name: [vehicles.NAME]", dict)
    autopilot: Autopilot = key("sampled control on board: [autopilot]", Autopilot.model_construct)
    avoidance: Avoidance | None = key("barriers and guard in flight: [avoidance]")
    constraint: Constraint = key("the constraint force: [constraint]", Constraint.model_construct)
    lqr: Lqr = key("regulator of the virtual body: [lqr]", Lqr.model_construct)
    tracking: Tracking = key("regulator of each agent: [tracking]", Tracking.model_construct)
    allocation: Allocation = key(
        "from wrench to forces on agents: [allocation]", Allocation.model_construct
    )
    integrator: IntegratorOptions = key(
        "tolerances of the integrator: [integrator]",
        IntegratorOptions.model_construct,
    )
    body_frame: BodyFrame | None = key("attitude of the body frame at t = 0: [body_frame]")
    formations: dict[str, Formation] = key("formations by name: [formations.NAME]", dict)
    obstacles: tuple[Obstacle, ...] = key("obstacles: [[obstacles]]", ())
    fences: tuple[Fence, ...] = key("fences of polygons: [[fences]]", ())
    people: tuple[People, ...] = key("places where people are: [[people]]", ())
    limits: Limits = key("limits that the verdict checks: [limits]", Limits.model_construct)
    yaw: VehicleYaw = key("yaw of each vehicle: [yaw]", VehicleYaw.model_construct)
    geodetic_origin: GeodeticOrigin | None = key(
        "place of the origin on the Earth, for exports: [geodetic_origin]"
    )
    network: Network | None = key(
        "messages between vehicles, only with [vehicles]: [network]; default: one law knows all states"
    )
    disturbances: Disturbances | None = key(
        "wind, gusts, noise, mass errors, lost vehicles: [disturbances]"
    )
    abort: Aborting | None = key("how the flight is aborted: [abort]")
    phases: Annotated[tuple[Phase, ...], Field(min_length=1)] = required_key(
        "phases of the flight, in order: [[phases]]"
    )
