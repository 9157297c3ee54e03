"""Viewer of the rig in rerun: drawings (`painter`), layout (`blueprint`) and sources (`file`, `live`).

Units on screen: mm, N, m/s^2 and Hz as in the channel table. Directions: x is EAST, y is up (NORTH), the free end is
+z; forward whirl turns counter-clockwise on screen, backward whirl clockwise.
"""
