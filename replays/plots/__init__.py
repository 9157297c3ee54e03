"""Pictures of runs, recordings and samples, each with the table of its numbers, in the style of `report.canvas`.

Kinds of pictures are functions, listed in `methods.KINDS`, which makes them methods (`run.plot.orbit(last_s=0.3)`) and
parts of `rig plot`. To add a kind: write a function of `Signals` with keyword options in the module of its family, or
in a new one; decorate it with `@kind()`, which adds the options that all kinds have; create panels by `make_axes`;
return a `Plot` of axes and table; and add one entry to `KINDS`. Matplotlib is imported only while a picture is drawn.
"""
