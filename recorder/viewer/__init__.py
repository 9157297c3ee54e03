"""The rig seen in rerun: what is drawn (`painter`), how it is laid out (`blueprint`), and from where (`file`, `live`).

Units on screen: mm, N, m/s^2 and Hz as in the channel table. Directions: x is EAST, y is up (NORTH), the free end is
+z; forward whirl turns counter-clockwise on screen, backward whirl clockwise.
"""
