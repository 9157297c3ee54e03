"""The reference implementation against statements that are not code.

| what | must agree with | why |
|---|---|---|
| angular momentum about the pivot | sum of the moments, in space vectors | Lagrange's equations against Newton-Euler |
| contact law, rotated scene | the same, rotated | no direction of the plane is special |
| steady precession of a level top | M g l / (Izz w), at large angles | gyroscopic terms, exact solution |
| small whirl on the magnets | roots of Ixx w^2 - Izz W w - K l0B^2 | sign and size of the gyroscopic coupling |
| forced whirl | closed form of the linear rotor | unbalance: size, phase, sense |
| spin-up, hammer alone | exponential, A d 2/pi | drive and pulse |
| drop | pendulum closed form, rebounds just below e^2, e^4, e^6 | gravity, event times, whole chain |
| Hertz impact | contact time, deepest point | normal law |
| damped impact | e asked = e returned; deepest point | exact factor, v0 |
| slow impact | the floor on v0 | trap |
| sliding impact | tangential = mu x normal impulse | friction's sign and size |
| house under a steady load | springs in series and parallel | house equations |
| lost preload | half the stiffness | one-sided transducers |
| stored energy | constant; or changes by the works done | everything at once |
| two solvers, two tolerances | each other | events are located, nothing is stepped over |
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from .reference import (
    WORKS,
    Array,
    Rig,
    axis_point,
    contact,
    contact_at,
    energies,
    gap,
    hanging,
    on_ring,
    pair_force,
    rhs,
    solve,
    transducers,
)

RIG = Rig(y0=-1.5e-3)
SPIN = 2 * math.pi * 6.2
HAMMER = (2e-3, 5e-3, 100.0, 0.0)
#: A house that no impact moves, with nothing that could move it.
FIXED = {"M_ih": 1e12, "K_bv": 0.0, "k_ns": 0.0, "k_ew": 0.0, "K_bh": 0.0, "D_bv": 0.0, "D_bh": 0.0}
#: Nothing but the contact acts on the shaft.
FREE = {"g": 0.0, "D_x": 0.0, "D_y": 0.0, "eps": 0.0, "c_d": 0.0, "y0": 0.0}
#: A ring that is out of reach.
FAR = {"r0": 10.0}


def axis(q: Array) -> Array:
    """Unit vector along the shaft, in space."""
    G, b = q[0], q[1]
    return np.array([math.sin(b), -math.sin(G) * math.cos(b), math.cos(G) * math.cos(b)])


def axis_rate(q: Array, qd: Array, h: float = 1e-4) -> Array:
    """d(axis)/dt, by differences along the motion (4th order; the axis is smooth on the scale of a radian)."""
    p = [axis(q + k * h * qd / (1 + np.abs(qd).max())) for k in (-2, -1, 1, 2)]
    return (p[0] - 8 * p[1] + 8 * p[2] - p[3]) / (12 * h) * (1 + np.abs(qd).max())


def angular_momentum(rig: Rig, q: Array, qd: Array) -> Array:
    a = axis(q)
    G = q[0]
    # the frame's turning, built from its two rotations in space: G' about x, b' about the y axis that G has turned
    turning = np.array([qd[0], qd[1] * math.cos(G), qd[1] * math.sin(G)])
    w = turning @ a + qd[2]
    return rig.Ixx * (turning - (turning @ a) * a) + rig.Izz * w * a


def random_state(rng: np.random.Generator, size: float) -> Array:
    y = size * rng.standard_normal(14)
    y[2], y[9] = rng.uniform(0, 6), rng.uniform(-60, 60)
    y[3:7] *= 1e-4
    y[10:14] *= 0.1
    return y


@pytest.mark.parametrize("ideal", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_angular_momentum_grows_by_the_moments_in_space(seed: int, ideal: bool) -> None:
    rng = np.random.default_rng(seed)
    rig = replace(RIG, K=1e6, v_s=0.1, D_x=11.0, D_y=17.0, eps=3e-3, a5=2e6, a7=3e9, ideal_drive=ideal)
    y = random_state(rng, 0.3)
    omega0, hammer, t, v0 = 50.0, (0.0, 1.0, 40.0, 0.7), 0.3, 0.5
    out = rhs(rig, t, y, omega0=omega0, v0=v0, hammer=hammer, magnet=True)
    q, qd, qdd = y[:3], y[7:10], out[7:10]
    a, ad = axis(q), axis_rate(q, qd)

    h = 1e-5
    moved = [angular_momentum(rig, q + k * h * qd, qd + k * h * qdd) for k in (-2, -1, 1, 2)]
    rate = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * h)

    def moment(arm: float, force: Array) -> Array:
        return arm * np.cross(a, force)

    B, Bd = rig.l0B * a[:2], rig.l0B * ad[:2]
    r = math.hypot(*B)
    pull = rig.K_mag * (r + rig.a3 * r**3 + rig.a5 * r**5 + rig.a7 * r**7) / r
    turned = y[2] + rig.phi
    total = moment(rig.l0B, np.array([-pull * B[0] - rig.D_x * Bd[0], -pull * B[1] - rig.D_y * Bd[1], 0.0]))
    total += moment(rig.l0C, np.array([0.0, -rig.M * rig.g, 0.0]))
    total += moment(rig.l0I, rig.M * rig.eps * y[9] ** 2 * np.array([math.cos(turned), math.sin(turned), 0.0]))
    total += moment(rig.l0I, 40.0 * math.sin(math.pi * 0.3) * np.array([math.cos(0.7), math.sin(0.7), 0.0]))
    e = rig.l0A * a[:2] - y[3:5] - [rig.x0, rig.y0]
    n = e / np.linalg.norm(e)
    slide = np.array([-n[1], n[0]])
    u = rig.l0A * ad[:2] - y[10:12]
    w = angular_momentum(rig, q, qd) @ a / rig.Izz
    F_n = max(0.0, rig.K * (np.linalg.norm(e) - rig.r0) ** 1.5 * (1 + rig.c * (u @ n) / v0))
    F_t = rig.mu * F_n * math.tanh((u @ slide + rig.R_S * w) / rig.v_s)
    total += moment(rig.l0A, np.array([*(-F_n * n - F_t * slide), 0.0])) - rig.R_S * F_t * a
    house = F_n * n + F_t * slide

    rest = rate - total  # the drive is what is left, and may act along the axis only
    scale = np.abs(rate).max()
    assert F_n > 0.0
    assert np.linalg.norm(rest - (rest @ a) * a) < 1e-7 * scale
    if ideal:
        assert out[9] == 0.0
    else:
        assert rest @ a == pytest.approx(rig.c_d * (omega0 - y[9]), abs=1e-7 * scale)
    # the house gets the opposite force
    x = rig.M_ih * out[10] + rig.M_oh * out[12] + rig.k_ew * y[5]
    yy = rig.M_ih * out[11] + rig.M_oh * out[13] + rig.D_bh * y[13] + rig.K_bh * y[6]
    assert (x, yy) == pytest.approx(tuple(house), rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("angle", np.linspace(0.1, 6.2, 13))
def test_contact_force_turns_with_the_scene(angle: float) -> None:
    rng = np.random.default_rng(7)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    for _ in range(20):
        shaft, house, centre = rng.standard_normal(4), 0.3 * rng.standard_normal(4), 0.1 * rng.standard_normal(2)
        rig = replace(RIG, r0=0.05, K=3.0, v_s=0.5, x0=centre[0], y0=centre[1])
        plain = contact(rig, tuple(shaft), tuple(house), 4.0, 0.7)
        new_centre = turn @ centre
        turned = contact(
            replace(rig, x0=new_centre[0], y0=new_centre[1]),
            tuple(np.concatenate([turn @ shaft[:2], turn @ shaft[2:]])),
            tuple(np.concatenate([turn @ house[:2], turn @ house[2:]])),
            4.0,
            0.7,
        )
        assert turn @ [plain.Fx, plain.Fy] == pytest.approx([turned.Fx, turned.Fy], rel=1e-11, abs=1e-12)
        assert turned.couple == pytest.approx(plain.couple, rel=1e-11, abs=1e-14)
        # the normal part pushes the shaft inward, the friction opposes the sliding
        assert plain.F_n >= 0.0
        assert plain.F_t * plain.v_t >= 0.0


@pytest.mark.parametrize("angle", [0.4, 2.0, 3.9, 5.5])
def test_whole_shaft_turns_with_the_scene(angle: float) -> None:
    rng = np.random.default_rng(3)
    rig = replace(RIG, **FIXED | FREE | {"D_x": 3.0, "D_y": 3.0, "K": 1e6, "v_s": 0.1, "y0": 0.0, "c_d": 0.1})
    y = random_state(rng, 0.2)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])

    def motion(y: Array) -> tuple[Array, Array, float, Array, float]:
        qdd = rhs(rig, 0.0, y, omega0=20.0, v0=0.4)[7:10]
        h = 1e-4
        rates = [axis_rate(y[:3] + k * h * y[7:10], y[7:10] + k * h * qdd) for k in (-1, 1)]
        w_rate = qdd[2] + qdd[0] * math.sin(y[1]) + y[7] * y[8] * math.cos(y[1])
        w = y[9] + y[7] * math.sin(y[1])
        # the drive sees theta', which is w less the frame's own turning about the axis: taken out of the comparison
        w_rate -= rig.c_d / rig.Izz * (20.0 - y[9])
        return axis(y[:3]), axis_rate(y[:3], y[7:10]), w, (rates[1] - rates[0]) / (2 * h), w_rate

    a, ad, w, add, w_rate = motion(y)
    a2, ad2 = turn @ a, turn @ ad
    z = y.copy()
    z[1] = math.asin(a2[0])
    z[0] = math.atan2(-a2[1], a2[2])
    z[8] = ad2[0] / math.cos(z[1])
    z[7] = (math.sin(z[0]) * math.sin(z[1]) * z[8] - ad2[1]) / (math.cos(z[0]) * math.cos(z[1]))
    z[9] = w - z[7] * math.sin(z[1])
    z[3:5], z[10:12] = turn[:2, :2] @ y[3:5], turn[:2, :2] @ y[10:12]
    b, bd, w2, bdd, w2_rate = motion(z)
    assert b == pytest.approx(a2, abs=1e-12)
    assert bd == pytest.approx(ad2, abs=1e-9)
    assert w2 == pytest.approx(w)
    assert bdd == pytest.approx(turn @ add, rel=1e-5, abs=1e-5 * np.abs(add).max())
    assert w2_rate == pytest.approx(w_rate, rel=1e-9)


def test_level_top_precesses_steadily_at_large_angles() -> None:
    # An axis that stays level turns about the vertical at M g l / (Izz w), whatever the angle.
    rig = replace(RIG, **FREE | FAR | {"g": 9.81})
    w = 2000.0
    rate = rig.M * rig.g * rig.l0C / (rig.Izz * w)
    y = np.zeros(14)
    y[8], y[9] = rate, w
    t = np.linspace(0, 0.8, 5)
    states = solve(rig, y, t, omega0=0.0, magnet=False, max_step=1e-3, rtol=1e-10).states
    assert states[-1, 1] > 1.1  # rad: far from small
    assert states[:, 1] == pytest.approx(rate * t, abs=1e-8)
    assert states[:, 0] == pytest.approx(0.0, abs=1e-8)
    assert states[:, 9] == pytest.approx(w, rel=1e-10)


@pytest.mark.parametrize("spin", [SPIN, 400.0, -400.0, 5000.0])
@pytest.mark.parametrize("which", [0, 1])
def test_small_whirl_has_the_gyroscopic_frequencies(spin: float, which: int) -> None:
    rig = replace(RIG, **FREE | FAR | {"ideal_drive": True})
    root = np.roots([rig.Ixx, -rig.Izz * spin, -rig.K_mag * rig.l0B**2])
    wh = float(np.sort(root.real)[which])  # backward (negative), forward
    size = 1e-6
    y = np.zeros(14)
    y[1], y[7], y[9] = size, -size * wh, spin  # x + i y = l (b - i G) = l size e^(i wh t)
    t = np.linspace(0, 6.0 / abs(wh), 4)
    states = solve(rig, y, t, omega0=spin, max_step=1e-3, rtol=1e-10).states
    assert states[:, 1] - 1j * states[:, 0] == pytest.approx(size * np.exp(1j * wh * t), abs=1e-8 * size)


def test_unbalance_drives_the_linear_rotors_forced_whirl() -> None:
    rig = replace(RIG, **FREE | FAR | {"eps": 1e-7, "ideal_drive": True, "a3": 0.0})
    spin = 30.0
    stiffness = rig.K_mag * rig.l0B**2 - (rig.Ixx - rig.Izz) * spin**2
    u0 = rig.l0I * rig.M * rig.eps * spin**2 / stiffness * np.exp(1j * rig.phi)
    y = np.zeros(14)
    y[1], y[0] = u0.real, -u0.imag
    y[8], y[7] = (1j * spin * u0).real, -(1j * spin * u0).imag
    y[9] = spin
    t = np.linspace(0, 0.3, 7)
    states = solve(rig, y, t, omega0=spin, max_step=1e-3, rtol=1e-10).states
    assert states[:, 1] - 1j * states[:, 0] == pytest.approx(u0 * np.exp(1j * spin * t), abs=1e-8 * abs(u0))


def test_drive_and_hammer_alone() -> None:
    rig = replace(RIG, **FREE | FAR | {"c_d": 0.02})
    t = np.linspace(0, 0.02, 5)
    got = solve(rig, np.zeros(14), t, omega0=SPIN, magnet=False, max_step=1e-3, rtol=1e-10)
    assert got.states[:, 9] == pytest.approx(SPIN * (1 - np.exp(-rig.c_d / rig.Izz * t)), rel=1e-9)

    rig = replace(RIG, **FREE | FAR)
    y = np.zeros(14)
    got = solve(rig, y, np.array([0.0, 0.01]), omega0=0.0, magnet=False, hammer=(2e-3, 5e-3, 100.0, 0.0)).states[-1]
    # cos(beta) at the hammer's arm is 1 to 2e-5
    assert got[8] == pytest.approx(rig.l0I * 100.0 * 5e-3 * 2 / math.pi / rig.Ixx, rel=1e-4)
    got = solve(rig, y, np.array([0.0, 0.01]), omega0=0.0, magnet=False, hammer=(2e-3, 5e-3, 100.0, math.pi / 2))
    assert got.states[-1, 7] == pytest.approx(-rig.l0I * 100.0 * 5e-3 * 2 / math.pi / rig.Ixx, rel=1e-4)


def test_drop_is_the_pendulum() -> None:
    rig = replace(RIG, **FIXED | FREE | {"g": 9.81})
    got = solve(rig, on_ring(rig, angle=math.pi / 2), np.array([0.0, 0.12]), omega0=0.0, magnet=False, max_step=2e-4)
    fall = rig.M * rig.g * rig.l0C * rig.l0A / rig.Ixx
    time, speed = got.onsets[0]
    assert time == pytest.approx(math.sqrt(4 * rig.r0 / fall), rel=3e-5)
    assert speed == pytest.approx(math.sqrt(4 * rig.r0 * fall), rel=3e-5)
    assert 25.55e-3 < time < 25.65e-3
    assert 0.1440 < speed < 0.1455
    heights = [v * v / (2 * fall) for _, v in got.liftoffs[:3]]
    # The weight goes on pressing during the contact (a t_c is 2 % of the speed): a little less than e^2, e^4, e^6.
    assert [round(1e3 * h, 2) for h in heights] == [1.50, 1.21, 0.97]
    free = [2 * rig.r0 * 0.9 ** (2 * k) for k in (1, 2, 3)]
    assert all(0.988 * f < h < f for h, f in zip(heights, free, strict=True))


def head_on(rig: Rig, speed: float, n: int = 2) -> tuple[float, float, float, Array]:
    """A flight from the centre to the east: (contact time, v0, separation speed, states from 0 to past lift-off)."""
    y = on_ring(rig, angle=0.0, radius=0.5 * rig.r0)
    y[8] = speed / (rig.l0A * math.cos(math.asin(rig.r0 / rig.l0A)))
    contact_time = 3.2181 * ((rig.Ixx / rig.l0A**2) ** 2 / (rig.K**2 * speed)) ** 0.2
    end = 0.5 * rig.r0 / speed + 2.5 * contact_time
    got = solve(rig, y, np.linspace(0, end, n), omega0=0.0, magnet=False, max_step=1e-4)
    assert len(got.onsets) == len(got.liftoffs) == 1
    return got.liftoffs[0][0] - got.onsets[0][0], got.onsets[0][1], got.liftoffs[0][1], got.states


@pytest.mark.parametrize("speed", [0.05, 0.25, 1.0])
def test_hertz_impact_lasts_as_the_closed_form(speed: float) -> None:
    rig = replace(RIG, **FIXED | FREE | {"c": 0.0, "mu": 0.0})
    b = math.asin(rig.r0 / rig.l0A)
    mass = rig.Ixx / (rig.l0A * math.cos(b)) ** 2
    lasted, v, back, states = head_on(rig, speed, 2000)
    deepest = (1.25 * mass * v * v / rig.K) ** 0.4
    assert v == pytest.approx(speed, rel=2e-5)
    # the lever's length changes by 1e-5 over the depth
    assert lasted == pytest.approx(2.943275 * deepest / v, rel=2e-5)
    assert lasted == pytest.approx(3.2181 * (mass**2 / (rig.K**2 * v)) ** 0.2, rel=1e-4)
    assert back == pytest.approx(v, rel=1e-9)
    assert float(gap(rig, states.T)[0].max()) == pytest.approx(deepest, rel=1e-3)


@pytest.mark.parametrize("asked", [0.95, 0.9, 0.8, 0.5, 0.2])
def test_exact_factor_returns_the_asked_restitution(asked: float) -> None:
    from scipy.optimize import brentq

    def condition(c: float) -> float:
        return c * (1 + asked) - math.log((1 + c) / (1 - c * asked))

    c = float(brentq(condition, 1e-6, 1 / asked - 1e-12, xtol=1e-15))  # type: ignore[arg-type]
    rig = replace(RIG, **FIXED | FREE | {"c": c, "mu": 0.0})
    _, v, back, states = head_on(rig, 0.2, 4000)
    assert back / v == pytest.approx(asked, rel=1e-5)
    # first integral of m v dv/dd = -K d^1.5 (1 + c v/v0), from v0 to 0
    mass = rig.Ixx / (rig.l0A * math.cos(math.asin(rig.r0 / rig.l0A))) ** 2
    deepest = (2.5 * mass * v * v / rig.K * (1 / c - math.log1p(c) / c**2)) ** 0.4
    assert float(gap(rig, states.T)[0].max()) == pytest.approx(deepest, rel=1e-3)


def test_published_factors_match_the_equation() -> None:
    for e, c in ((0.9, 0.1665), (0.8, 0.3731), (0.5, 1.4328)):
        assert c * (1 + e) == pytest.approx(math.log((1 + c) / (1 - c * e)), rel=2e-3)


def test_slow_impact_keeps_the_floor() -> None:
    rig = replace(RIG, **FIXED | FREE | {"mu": 0.0})
    y = on_ring(rig, angle=0.0)
    y[8] = 2e-4 / rig.l0A
    got = solve(rig, y, np.array([0.0, 0.02]), omega0=0.0, magnet=False)
    assert got.onsets[0] == (0.0, rig.v_floor)
    # with the floor the damping is that of a factor c v/v_floor: e solves the exact equation for it
    c = rig.c * 2e-4 / rig.v_floor
    e = got.liftoffs[0][1] / 2e-4
    assert c * (1 + e) == pytest.approx(math.log((1 + c) / (1 - c * e)), rel=1e-4)


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_sliding_impact_has_coulombs_impulse(sense: float) -> None:
    # No spin inertia and a held speed: no gyroscopic moment, and the surface never stops sliding. A hard contact: the
    # normal must not turn while it lasts.
    rig = replace(RIG, **FIXED | FREE | {"Izz": 1e-12, "ideal_drive": True, "v_s": 1e-6, "K": 1e15})
    y = on_ring(rig, angle=0.0)
    v, y[9] = 0.2, sense * 200.0
    y[8] = v / (rig.l0A * math.cos(y[1]))
    got = solve(rig, y, np.array([0.0, 1e-4]), omega0=0.0, magnet=False)
    assert len(got.liftoffs) == 1
    _, _, vx, vy = axis_point(rig.l0A, got.states[-1])
    # friction pushes the top of the scene down when the shaft turns forward: against the surface's motion
    assert float(vy) / (v - float(vx)) == pytest.approx(-sense * rig.mu, rel=2e-3)
    # the drive pays for what it holds: work = w x (R_S x tangential impulse)
    mass = rig.Ixx / rig.l0A**2
    assert got.works[-1, 0] == pytest.approx(200.0 * rig.R_S * abs(float(vy)) * mass, rel=2e-3)


def test_house_under_a_steady_load_is_springs() -> None:
    Fx, Fy = 300.0, -200.0
    y = np.zeros(14)
    y[5], y[6] = Fx / RIG.k_ew, Fy / RIG.K_bh
    y[3], y[4] = y[5] + Fx / RIG.K_bv, y[6] + Fy / RIG.k_ns
    rates = rhs(RIG, 0.0, y, omega0=0.0)[10:14]
    assert rates == pytest.approx([-Fx / RIG.M_ih, -Fy / RIG.M_ih, 0.0, 0.0], abs=1e-9 * Fx)
    # up loads north, east loads east: half of the load each, about the preload
    changes = np.array(transducers(RIG, y)) - RIG.P0
    assert changes == pytest.approx([Fy / 2, -Fy / 2, Fx / 2, -Fx / 2])


def test_lost_preload_halves_the_stiffness() -> None:
    k, P0 = 1e8, 100.0
    u0 = 2 * P0 / k
    assert pair_force(0.5 * u0, k, P0) == pytest.approx(P0)
    assert pair_force(3 * u0, k, P0) == pytest.approx(2 * P0 + k / 2 * 2 * u0)
    # and the stop there keeps the energy: an oscillation well into the half-open range
    rig = replace(RIG.conservative, P0=P0, r0=10.0)
    y = np.zeros(14)
    y[11], y[10] = 0.3, 0.2
    got = solve(rig, y, np.linspace(0, 0.01, 41), omega0=0.0, max_step=1e-4)
    readings = np.array(transducers(rig, got.states.T))
    assert (readings == 0.0).any(axis=1).all()  # all four come loose at some time
    stored = [energies(rig, s)["total"] for s in got.states]
    assert stored == pytest.approx([stored[0]] * 41, rel=1e-9)


def test_energy_is_kept_without_losses() -> None:
    rig, y = hanging(RIG, spin=SPIN)
    rig = rig.conservative
    y[8], y[7] = 1.3, 0.4
    got = solve(rig, y, np.linspace(0, 0.04, 81), omega0=0.0)
    assert len(got.onsets) >= 3
    stored = np.array([energies(rig, s)["total"] for s in got.states])
    assert np.abs(stored - stored[0]).max() < 1e-9 * 0.5 * rig.Ixx * 1.3**2
    assert np.abs(got.works).max() == 0.0
    # no torque about the axis: the spin about it stays
    w = got.states[:, 9] + got.states[:, 7] * np.sin(got.states[:, 1])
    assert w == pytest.approx(SPIN, rel=1e-11)


@pytest.mark.parametrize("ideal", [False, True])
def test_stored_energy_changes_by_the_works(ideal: bool) -> None:
    rig, y = hanging(replace(RIG, ideal_drive=ideal, P0=700.0), spin=SPIN)
    t = np.linspace(0, 0.03, 61)
    got = solve(rig, y, t, omega0=SPIN, hammer=HAMMER)
    stored = np.array([energies(rig, s)["total"] for s in got.states])
    done = dict(zip(WORKS, got.works[-1], strict=True))
    assert len(got.onsets) >= 5
    assert all(done[name] < 0.0 for name in WORKS if name.endswith(("damping", "friction")))
    assert done["hammer"] > 0.05
    dissipated = -sum(v for v in done.values() if v < 0.0)
    assert np.abs(stored - stored[0] - got.works.sum(axis=1)).max() < 1e-9 * dissipated
    # asked states see the latched speed exactly while there is a gap force
    running = ~np.isnan(got.v0)
    assert running.any()
    assert ((gap(rig, got.states.T)[0] > 0) == running).all()
    at = int(np.flatnonzero(running)[0])
    assert contact_at(rig, got.states[at], float(got.v0[at])).F_n > 0.0


def test_solver_and_tolerance_do_not_matter() -> None:
    rig, y = hanging(RIG, spin=SPIN)
    t = np.linspace(0, 0.0185, 20)
    scale = np.array([5e-3, 5e-3, 1.0, *[2e-5] * 4, 1.0, 1.0, 40.0, *[0.1] * 4])

    def run(**options: float | str) -> Array:
        return solve(rig, y, t, omega0=SPIN, hammer=HAMMER, **options).states  # type: ignore[arg-type]

    best = run()
    assert np.abs((run(rtol=1e-9) - best) / scale).max() < 1e-7
    assert np.abs((run(rtol=1e-8, method="LSODA") - best) / scale).max() < 1e-5
    # restarted in the middle of a flight: the same
    half = solve(rig, best[10], t[10:], omega0=SPIN, hammer=HAMMER).states
    assert np.abs((half - best[10:]) / scale).max() < 1e-9
