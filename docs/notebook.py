"""Orbit, full spectrum and run-up, from a simulation and from recordings: `python docs/notebook.py [PICTURE.png]`."""

# %% The hammer and a run-up, simulated here
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import rig
from recorder.reader import Recording
from replays.recordings.export import write_run

faster = {"drive.profile": [[0.0, 1.0], [9.0, 10.0]], "duration_s": 9.0, "sensors.rate_hz": 2000}
hammer = rig.simulate("hammer", {"drive.speed_hz": 6.2, "duration_s": 1.0})
run_up = rig.simulate("run-up", faster)

# %% The same from recordings: the hammer at another speed, and a run-up with more unbalance, recorded here
heavier = rig.load_scene("run-up", faster | {"shaft.unbalance_eccentricity": 0.2})
write_run(rig.Simulation(heavier), Path("run-up.mcap"), force=True)
with Recording.open("replays/sessions/hammer-5.2.mcap") as impact, Recording.open("run-up.mcap") as run:
    recorded = [(impact.samples("probes"), impact.edges()), (run.samples("probes"), run.edges())]

# %% One row each: orbit; full spectrum (backward whirl on the left); amplitude and phase at 1X
figure, axes = plt.subplots(2, 4, figsize=(16, 7), layout="constrained")
simulated = [(hammer.samples, hammer.edges_s), (run_up.samples, run_up.edges_s)]
for row, title, ((s, _), (r, edges_s)) in zip(axes, ("simulated", "recorded"), (simulated, recorded), strict=True):
    x, y, unit = s["disk_x"], s["disk_y"], s.unit("disk_x")
    row[0].plot(x, y, lw=0.4)
    row[0].set(title=f"Hammer, {title}", xlabel=f"disk_x [{unit}]", ylabel=f"disk_y [{unit}]", aspect="equal")
    late = s.times_s > s.times_s[-1] - 0.3
    row[1].plot(*rig.full_spectrum(x[late], y[late], s.rate_hz, lines=1 << 16))
    row[1].set(
        title="Its last 0.3 s", xlim=(-150, 150), xlabel="backward - frequency [Hz] - forward", ylabel=f"[{unit}]"
    )
    speed_hz, vector = rig.synchronous(r["disk_x"], r.times_s, edges_s)
    row[2].plot(speed_hz, np.abs(vector), ".-")
    row[2].set(title=f"Run-up, {title}", xlabel="speed [Hz]", ylabel=f"1X of disk_x [{r.unit('disk_x')}]")
    row[3].plot(speed_hz, np.degrees(np.unwrap(np.angle(vector))), ".-")
    row[3].set(title="Phase from the keyphasor", xlabel="speed [Hz]", ylabel="[degrees]")
figure.savefig(*sys.argv[1:] or ["notebook.png"])
