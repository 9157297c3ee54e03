"""Work-precision charts: our engines and other solvers on the same windows, by speed and error.

`session.make_chart` runs the chart, `phases` defines windows and points, `methods` the engines and peers, `measure`
measures one point, `profile` compares methods over random scenes, `store` keeps the results, and `figure` draws them.
"""
