"""Work-precision charts: our engines and other people's solvers on the same windows, by speed and by error.

`session.make_chart` runs the whole; `phases` says what is compared on which windows, `methods` who takes part,
`measure` makes one point, `profile` compares over random scenes, `store` keeps what was measured, `figure` draws it.
"""
