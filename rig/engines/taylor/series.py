"""Coefficients of the Taylor series, by phase.

Made by `NUMBA_DISABLE_JIT=1 python -m rig.engines.tape.taylor`: do not edit; tests/physics/test_taylor.py compares it.
"""

# pyright: reportPossiblyUnboundVariable=false

from __future__ import annotations

import math

from rig.engines.memory import ONSET, PHASE
from rig.engines.taylor.lanes import complex_power, is_wide, product, quotient, sum_below
from rig.engines.taylor.place import EAST, NORTH, ORDER, SLACK
from rig.kernels.contact import BACKWARD, EXACT, FLIGHT, FORWARD, NO_FRICTION, ROLLING, SMOOTHED, TOUCHING  # noqa: F401
from rig.kernels.geometry import sines_of
from rig.kernels.magnet import LINEAR, RADIAL, RIPPLED  # noqa: F401
from rig.kernels.stage import kernel


LANES = 128


@kernel
def flight(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Flight: 48 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east = memory[NORTH], memory[EAST]
    c0 = -1.0 * (1.0 if levels.euler else 0.0)
    c1 = (1.0 if levels.euler else 0.0)
    c2 = shaft.arm_ring
    c3 = -1.0 * contact.gap_counts_outer
    c4 = -1.0 * contact.offset_x
    c5 = -1.0 * shaft.arm_ring
    c6 = -1.0 * contact.offset_y
    c7 = shaft.arm_magnet * shaft.arm_magnet
    c8 = magnet.a7
    c9 = magnet.a5
    c10 = magnet.a3
    c11 = shaft.arm_magnet
    c12 = magnet.growth
    c13 = -1.0 * magnet.stiffness
    c14 = -1.0 * shaft.arm_magnet
    c15 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c16 = magnet.number * magnet.ripple * magnet.stiffness
    c17 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c18 = magnet.stiffness * shaft.arm_magnet
    c19 = -1.0 * magnet.damping_x * shaft.arm_magnet
    c20 = -1.0 * magnet.damping_y * shaft.arm_magnet
    c21 = 0.5 * house.pair_stiffness_vertical
    c22 = house.preload
    c23 = -0.5 * house.pair_stiffness_vertical
    c24 = house.inner_beam_stiffness
    c25 = house.inner_beam_damping
    c26 = -1.0 / house.inner_mass
    c27 = 0.5 * house.pair_stiffness_horizontal
    c28 = -0.5 * house.pair_stiffness_horizontal
    c29 = house.outer_beam_stiffness
    c30 = house.outer_beam_damping
    c31 = 1.0 / house.outer_mass
    c32 = inputs.speed_slope
    c33 = aim
    c34 = shaft.unbalance
    c35 = inputs.hammer_force * inputs.hammer_y
    c36 = shaft.arm_disk
    c37 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c38 = -1.0 * shaft.polar_inertia
    c39 = 1.0 / shaft.transverse_inertia
    c40 = 2.0 * (1.0 if levels.euler else 0.0)
    c41 = inputs.hammer_force * inputs.hammer_x
    c42 = shaft.polar_inertia
    c43 = constants.torque_gain / shaft.polar_inertia
    c44 = constants.torque_gain
    c45 = pulse
    c46 = -1.0 * pulse
    i219 = 0.0
    Y[0, 29] = 0.0
    Y[0, 30], Y[0, 31] = math.sin(along), math.cos(along)
    Y[0, 32], Y[0, 33] = sines_of(levels, Y[0, 0])
    Y[0, 34], Y[0, 35] = sines_of(levels, Y[0, 1])
    Y[0, 36], Y[0, 37] = math.sin(Y[0, 2] + shaft.unbalance_phase), math.cos(Y[0, 2] + shaft.unbalance_phase)
    wide = is_wide(constants, inputs)
    for p in range(96):
        A[0, p] = B[0, p] = 0.0
    z, later = 1.0, 0.0
    for k in range(ORDER):
        if wide:
            sum_below(A, B, acc, k, 96)
        else:
            sum_below(A, B, acc, k, 48)
        v3 = Y[k, 3]
        v4 = Y[k, 4]
        v5 = Y[k, 5]
        v6 = Y[k, 6]
        v7 = Y[k, 7]
        v8 = Y[k, 8]
        v9 = Y[k, 9]
        v10 = Y[k, 10]
        v12 = Y[k, 12]
        v13 = Y[k, 13]
        v29 = Y[k, 35]
        v30 = product(A, B, acc, k, later, 0, v7, v29)
        v31 = Y[k, 32]
        v32 = Y[k, 33]
        v33 = product(A, B, acc, k, later, 1, v7, v32)
        v34 = product(A, B, acc, k, later, 2, v7, v31)
        D[k, 32] = v33
        D[k, 33] = c0 * v34
        v37 = Y[k, 34]
        v38 = product(A, B, acc, k, later, 3, v8, v29)
        v39 = product(A, B, acc, k, later, 4, v8, v37)
        D[k, 34] = v38
        D[k, 35] = c0 * v39
        v42 = product(A, B, acc, k, later, 5, v31, v37)
        v43 = product(A, B, acc, k, later, 6, v7, v37)
        v44 = v9 + c1 * v43
        v45 = product(A, B, acc, k, later, 7, v29, v31)
        v46 = product(A, B, acc, k, later, 8, v29, v32)
        v47 = product(A, B, acc, k, later, 9, v30, v32)
        v48 = product(A, B, acc, k, later, 10, v31, v39)
        v49 = -v47 + c1 * v48
        v52 = c2 * v37 - v3 + c3 * v5 + c4 * z
        v55 = c5 * v45 - v4 + c3 * v6 + c6 * z
        v60 = product(A, B, acc, k, later, 11, v52, v52)
        v61 = product(A, B, acc, k, later, 12, v55, v55)
        v62 = v60 + v61
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v147 = c17 * v37
                v148 = c18 * v45
            elif magnet.terms == RADIAL:
                v95 = product(A, B, acc, k, later, 13, v37, v37)
                v96 = product(A, B, acc, k, later, 14, v45, v45)
                v97 = c7 * v95 + c7 * v96
                v99 = product(A, B, acc, k, later, 15, v97, c8 * v97 + c9 * z)
                v101 = product(A, B, acc, k, later, 16, v97, v99 + c10 * z)
                v102 = v101 + z
                v109 = product(A, B, acc, k, later, 17, v37, v102)
                v110 = product(A, B, acc, k, later, 18, v45, v102)
                v147 = c17 * v109
                v148 = c18 * v110
            else:
                v111 = product(A, B, acc, k, later, 48, v37, v37)
                v112 = product(A, B, acc, k, later, 49, v45, v45)
                v113 = c7 * v111 + c7 * v112
                v115 = product(A, B, acc, k, later, 50, v113, c8 * v113 + c9 * z)
                v117 = product(A, B, acc, k, later, 51, v113, v115 + c10 * z)
                power_x, power_y = complex_power(A, B, acc, k, later, 58, c11 * v45, c11 * v37, int((magnet.number + -1.0)))
                v126 = power_x
                v127 = power_y
                v128 = product(A, B, acc, k, later, 52, v45, v126)
                v129 = product(A, B, acc, k, later, 53, v37, v127)
                v131 = c12 * v113 + z
                v132 = c13 * (v117 + z) + c15 * (c11 * v128 + c14 * v129)
                v133 = product(A, B, acc, k, later, 54, v37, v132)
                v134 = product(A, B, acc, k, later, 55, v127, v131)
                v147 = c11 * v133 + c16 * v134
                v136 = product(A, B, acc, k, later, 56, v45, v132)
                v137 = product(A, B, acc, k, later, 57, v126, v131)
                v148 = c14 * v136 + c16 * v137
            v150 = c19 * v38
            v151 = c20 * v49
        else:
            v147 = 0.0
            v148 = 0.0
            v150 = 0.0
            v151 = 0.0
        v154 = Y[k, 30]
        v157 = product(A, B, acc, k, later, 19, v9, Y[k, 37])
        v158 = product(A, B, acc, k, later, 20, v9, Y[k, 36])
        D[k, 36] = v157
        D[k, 37] = -v158
        v161 = product(A, B, acc, k, later, 21, v9, v157)
        v162 = product(A, B, acc, k, later, 22, v9, v158)
        if levels.inner_house:
            v163 = v4 - v6
            v164 = c21 * v163 + c22 * z
            v176 = 0.0 if north < 0.0 else v164
            v166 = c23 * v163 + c22 * z
            v177 = 0.0 if north > 0.0 else v166
            v180 = v10 - v12
            v178 = c24 * (v3 - v5) + c25 * v180
            v182 = c26 * v178
            v183 = c26 * (v176 - v177)
        else:
            v176 = c22 * z
            v177 = c22 * z
            v178 = 0.0
            v180 = 0.0
            v182 = 0.0
            v183 = 0.0
        if levels.outer_house:
            v184 = c27 * v5 + c22 * z
            v197 = 0.0 if east < 0.0 else v184
            v186 = c28 * v5 + c22 * z
            v198 = 0.0 if east > 0.0 else v186
            v199 = c29 * v6 + c30 * v13
            v201 = c31 * (v178 - (v197 - v198))
            v202 = c31 * (v176 - v177 - v199)
        else:
            v197 = c22 * z
            v198 = c22 * z
            v199 = 0.0
            v201 = 0.0
            v202 = 0.0
        v205 = c32 * Y[k, 29] + c33 * z - v9
        v212 = c11 * (v148 + v151) + c36 * (c34 * v162 + c35 * v154) + c37 * z
        v214 = product(A, B, acc, k, later, 23, v32, v212)
        v215 = product(A, B, acc, k, later, 24, v8, v44)
        v217 = product(A, B, acc, k, later, 25, v8, v43)
        i219 = 1.0 / v29 if k == 0 else i219
        v219 = quotient(A, B, acc, k, later, 26, v29, c39 * (-v214 + c38 * v215) + c40 * v217, i219)
        v220 = product(A, B, acc, k, later, 27, v29, c11 * (v147 + v150) + c36 * (c34 * v161 + c41 * v154))
        v221 = product(A, B, acc, k, later, 28, v42, v212)
        v224 = product(A, B, acc, k, later, 29, v30, v44)
        v228 = product(A, B, acc, k, later, 30, v30, v43)
        v229 = c39 * (v220 + c1 * v221 + c42 * v224) + c0 * v228
        v230 = product(A, B, acc, k, later, 31, v37, v219)
        v231 = product(A, B, acc, k, later, 32, v8, v30)
        v232 = c1 * v230 + c1 * v231
        if inputs.ideal_drive:
            v234 = v232 + c32 * z
            v235 = c42 * v234
        else:
            v234 = c43 * v205
            v235 = c44 * v205
        v236 = v234 - v232
        if levels.outer_house:
            v247 = v197
            v248 = v198
            v249 = v199
        elif levels.inner_house:
            v249 = v176 - v177
            v247 = 0.5 * v178 + c22 * z
            v248 = -0.5 * v178 + c22 * z
        else:
            v247 = c22 * z
            v248 = c22 * z
            v249 = 0.0
        v250 = product(A, B, acc, k, later, 33, v44, v235)
        v254 = product(A, B, acc, k, later, 34, v154, c41 * v38 + c35 * v49)
        v255 = product(A, B, acc, k, later, 35, v38, v161)
        v256 = product(A, B, acc, k, later, 36, v49, v162)
        v257 = c34 * v255 + c34 * v256
        v258 = product(A, B, acc, k, later, 37, v38, v150)
        v259 = product(A, B, acc, k, later, 38, v49, v151)
        v260 = v258 + v259
        v261 = product(A, B, acc, k, later, 39, v180, v180)
        v262 = product(A, B, acc, k, later, 40, v13, v13)
        v263 = c25 * v261 + c30 * v262
        v264 = product(A, B, acc, k, later, 41, v29, v214)
        v265 = product(A, B, acc, k, later, 42, v37, v235)
        v266 = -v264 + v265
        v267 = product(A, B, acc, k, later, 43, v32, v220)
        v268 = product(A, B, acc, k, later, 44, v45, v235)
        v269 = v267 - v268
        v270 = product(A, B, acc, k, later, 45, v37, v212)
        v271 = product(A, B, acc, k, later, 46, v31, v220)
        v273 = product(A, B, acc, k, later, 47, v46, v235)
        v274 = v270 + v271 + v273
        v275 = v247 - v248
        v276 = Y[k, 31]
        D[k, 0] = v7
        D[k, 1] = v8
        D[k, 2] = v9
        D[k, 3] = v10
        D[k, 4] = Y[k, 11]
        D[k, 5] = v12
        D[k, 6] = v13
        D[k, 7] = v219
        D[k, 8] = v229
        D[k, 9] = v236
        D[k, 10] = v182
        D[k, 11] = v183
        D[k, 12] = v201
        D[k, 13] = v202
        D[k, 14] = v250
        D[k, 15] = c36 * v254
        D[k, 16] = c36 * v257
        D[k, 17] = 0.0
        D[k, 18] = 0.0
        D[k, 19] = c14 * v260
        D[k, 20] = v263
        D[k, 21] = 0.0
        D[k, 22] = 0.0
        D[k, 23] = 0.0
        D[k, 24] = v266
        D[k, 25] = v269
        D[k, 26] = v274
        D[k, 27] = -v275
        D[k, 28] = -v249
        D[k, 29] = z
        D[k, 30] = c45 * v276
        D[k, 31] = c46 * v154
        Y[k, 39] = 0.0
        Y[k, 40] = v62
        Y[k, 41] = 0.0
        Y[k, 42] = 0.0
        portion = 1.0 / (k + 1.0)
        for i in range(38):
            Y[k + 1, i] = D[k, i] * portion
        Y[k + 1, 38] = 0.0
        z, later = 0.0, 1.0
    for i in range(39, 43):
        Y[ORDER, i] = 0.0


@kernel
def sliding(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Sliding: 64 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east = memory[NORTH], memory[EAST]
    c0 = -1.0 * (1.0 if levels.euler else 0.0)
    c1 = (1.0 if levels.euler else 0.0)
    c2 = shaft.arm_ring
    c3 = -1.0 * contact.gap_counts_outer
    c4 = -1.0 * contact.offset_x
    c5 = -1.0 * shaft.arm_ring
    c6 = -1.0 * contact.offset_y
    c7 = shaft.radius
    c8 = 2.0 * contact.exponent
    c9 = contact.stiffness
    c10 = contact.damping_factor / onset
    c11 = contact.viscous_damping
    c12 = 1.0 / contact.smoothing_speed
    c13 = contact.friction
    c14 = -1.0 * contact.friction
    c15 = shaft.arm_magnet * shaft.arm_magnet
    c16 = magnet.a7
    c17 = magnet.a5
    c18 = magnet.a3
    c19 = shaft.arm_magnet
    c20 = magnet.growth
    c21 = -1.0 * magnet.stiffness
    c22 = -1.0 * shaft.arm_magnet
    c23 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c24 = magnet.number * magnet.ripple * magnet.stiffness
    c25 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c26 = magnet.stiffness * shaft.arm_magnet
    c27 = -1.0 * magnet.damping_x * shaft.arm_magnet
    c28 = -1.0 * magnet.damping_y * shaft.arm_magnet
    c29 = 0.5 * house.pair_stiffness_vertical
    c30 = house.preload
    c31 = -0.5 * house.pair_stiffness_vertical
    c32 = house.inner_beam_stiffness
    c33 = house.inner_beam_damping
    c34 = -1.0 / house.inner_mass
    c35 = 0.5 * house.pair_stiffness_horizontal
    c36 = -0.5 * house.pair_stiffness_horizontal
    c37 = house.outer_beam_stiffness
    c38 = house.outer_beam_damping
    c39 = 1.0 / house.outer_mass
    c40 = inputs.speed_slope
    c41 = aim
    c42 = shaft.unbalance
    c43 = inputs.hammer_force * inputs.hammer_y
    c44 = shaft.arm_disk
    c45 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c46 = -1.0 * shaft.polar_inertia
    c47 = 1.0 / shaft.transverse_inertia
    c48 = 2.0 * (1.0 if levels.euler else 0.0)
    c49 = inputs.hammer_force * inputs.hammer_x
    c50 = shaft.polar_inertia
    c51 = constants.torque_gain
    c52 = -1.0 * shaft.radius
    c53 = 1.0 / shaft.polar_inertia
    c54 = contact.gap_counts_outer
    c55 = pulse
    c56 = -1.0 * pulse
    i67 = 0.0
    i68 = 0.0
    i241 = 0.0
    Y[0, 29] = 0.0
    Y[0, 30], Y[0, 31] = math.sin(along), math.cos(along)
    Y[0, 32], Y[0, 33] = sines_of(levels, Y[0, 0])
    Y[0, 34], Y[0, 35] = sines_of(levels, Y[0, 1])
    Y[0, 36], Y[0, 37] = math.sin(Y[0, 2] + shaft.unbalance_phase), math.cos(Y[0, 2] + shaft.unbalance_phase)
    wide = is_wide(constants, inputs)
    for p in range(120):
        A[0, p] = B[0, p] = 0.0
    z, later = 1.0, 0.0
    for k in range(ORDER):
        if wide:
            sum_below(A, B, acc, k, 120)
        else:
            sum_below(A, B, acc, k, 64)
        v3 = Y[k, 3]
        v4 = Y[k, 4]
        v5 = Y[k, 5]
        v6 = Y[k, 6]
        v7 = Y[k, 7]
        v8 = Y[k, 8]
        v9 = Y[k, 9]
        v10 = Y[k, 10]
        v11 = Y[k, 11]
        v12 = Y[k, 12]
        v13 = Y[k, 13]
        v29 = Y[k, 35]
        v30 = product(A, B, acc, k, later, 0, v7, v29)
        v31 = Y[k, 32]
        v32 = Y[k, 33]
        v33 = product(A, B, acc, k, later, 1, v7, v32)
        v34 = product(A, B, acc, k, later, 2, v7, v31)
        D[k, 32] = v33
        D[k, 33] = c0 * v34
        v37 = Y[k, 34]
        v38 = product(A, B, acc, k, later, 3, v8, v29)
        v39 = product(A, B, acc, k, later, 4, v8, v37)
        D[k, 34] = v38
        D[k, 35] = c0 * v39
        v42 = product(A, B, acc, k, later, 5, v31, v37)
        v43 = product(A, B, acc, k, later, 6, v7, v37)
        v44 = v9 + c1 * v43
        v45 = product(A, B, acc, k, later, 7, v29, v31)
        v46 = product(A, B, acc, k, later, 8, v29, v32)
        v47 = product(A, B, acc, k, later, 9, v30, v32)
        v48 = product(A, B, acc, k, later, 10, v31, v39)
        v49 = -v47 + c1 * v48
        v52 = c2 * v37 - v3 + c3 * v5 + c4 * z
        v55 = c5 * v45 - v4 + c3 * v6 + c6 * z
        v57 = c2 * v38 - v10 + c3 * v12
        v59 = c2 * v49 - v11 + c3 * v13
        v60 = product(A, B, acc, k, later, 11, v52, v52)
        v61 = product(A, B, acc, k, later, 12, v55, v55)
        v62 = v60 + v61
        v63 = math.sqrt(v62) if k == 0 else (v62 - acc[13]) * (0.5 / A[0, 13])
        A[k, 13] = B[k, 13] = v63
        v64 = Y[k, 38]
        v65 = product(A, B, acc, k, later, 14, v64, v64)
        i67 = 1.0 / v63 if k == 0 else i67
        v67 = quotient(A, B, acc, k, later, 15, v63, v52, i67)
        i68 = 1.0 / v63 if k == 0 else i68
        v68 = quotient(A, B, acc, k, later, 16, v63, v55, i68)
        v69 = product(A, B, acc, k, later, 17, v57, v67)
        v70 = product(A, B, acc, k, later, 18, v59, v68)
        v71 = v69 + v70
        v72 = product(A, B, acc, k, later, 19, v59, v67)
        v73 = product(A, B, acc, k, later, 20, v57, v68)
        v75 = v72 - v73 + c7 * v44
        if contact.exponent == 1.5:
            v76 = product(A, B, acc, k, later, 21, v64, v65)
            v79 = c9 * v76
        elif contact.exponent == 1.0:
            v79 = c9 * v65
        else:
            v77 = v64 ** c8 if k == 0 else (c8 * (acc[64] + k * v64 * B[0, 64]) - acc[65]) / (k * B[0, 65])
            A[k, 64], B[k, 64], A[k, 65], B[k, 65] = k * v64, v77, k * v77, v64
            v79 = c9 * v77
        v80 = c10 * v71 + z
        v81 = product(A, B, acc, k, later, 22, v79, v80)
        v82 = v81 + c11 * v71
        v83 = 0.0 if slack else v82
        if phase == FORWARD:
            v88 = c13 * v83
        elif phase == BACKWARD:
            v88 = c14 * v83
        elif levels.friction == SMOOTHED:
            v84 = math.tanh(c12 * v75) if k == 0 else (acc[66] + k * (c12 * v75) * B[0, 66]) / k
            A[k, 66] = k * (c12 * v75)
            B[k, 66] = z - product(A, B, acc, k, later, 67, v84, v84)
            v85 = product(A, B, acc, k, later, 68, v83, v84)
            v88 = c13 * v85
        else:
            v88 = 0.0
        v89 = product(A, B, acc, k, later, 23, v67, v83)
        v90 = product(A, B, acc, k, later, 24, v68, v88)
        v91 = -v89 + v90
        v92 = product(A, B, acc, k, later, 25, v68, v83)
        v93 = product(A, B, acc, k, later, 26, v67, v88)
        v94 = -v92 - v93
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v167 = c25 * v37
                v168 = c26 * v45
            elif magnet.terms == RADIAL:
                v115 = product(A, B, acc, k, later, 27, v37, v37)
                v116 = product(A, B, acc, k, later, 28, v45, v45)
                v117 = c15 * v115 + c15 * v116
                v119 = product(A, B, acc, k, later, 29, v117, c16 * v117 + c17 * z)
                v121 = product(A, B, acc, k, later, 30, v117, v119 + c18 * z)
                v122 = v121 + z
                v129 = product(A, B, acc, k, later, 31, v37, v122)
                v130 = product(A, B, acc, k, later, 32, v45, v122)
                v167 = c25 * v129
                v168 = c26 * v130
            else:
                v131 = product(A, B, acc, k, later, 69, v37, v37)
                v132 = product(A, B, acc, k, later, 70, v45, v45)
                v133 = c15 * v131 + c15 * v132
                v135 = product(A, B, acc, k, later, 71, v133, c16 * v133 + c17 * z)
                v137 = product(A, B, acc, k, later, 72, v133, v135 + c18 * z)
                power_x, power_y = complex_power(A, B, acc, k, later, 81, c19 * v45, c19 * v37, int((magnet.number + -1.0)))
                v146 = power_x
                v147 = power_y
                v148 = product(A, B, acc, k, later, 73, v45, v146)
                v149 = product(A, B, acc, k, later, 74, v37, v147)
                v151 = c20 * v133 + z
                v152 = c21 * (v137 + z) + c23 * (c19 * v148 + c22 * v149)
                v153 = product(A, B, acc, k, later, 75, v37, v152)
                v154 = product(A, B, acc, k, later, 76, v147, v151)
                v167 = c19 * v153 + c24 * v154
                v156 = product(A, B, acc, k, later, 77, v45, v152)
                v157 = product(A, B, acc, k, later, 78, v146, v151)
                v168 = c22 * v156 + c24 * v157
            v170 = c27 * v38
            v171 = c28 * v49
        else:
            v167 = 0.0
            v168 = 0.0
            v170 = 0.0
            v171 = 0.0
        v174 = Y[k, 30]
        v177 = product(A, B, acc, k, later, 33, v9, Y[k, 37])
        v178 = product(A, B, acc, k, later, 34, v9, Y[k, 36])
        D[k, 36] = v177
        D[k, 37] = -v178
        v181 = product(A, B, acc, k, later, 35, v9, v177)
        v182 = product(A, B, acc, k, later, 36, v9, v178)
        if levels.inner_house:
            v183 = v4 - v6
            v184 = c29 * v183 + c30 * z
            v196 = 0.0 if north < 0.0 else v184
            v186 = c31 * v183 + c30 * z
            v197 = 0.0 if north > 0.0 else v186
            v200 = v10 - v12
            v198 = c32 * (v3 - v5) + c33 * v200
            v202 = c34 * v198
            v203 = c34 * (v196 - v197)
        else:
            v196 = c30 * z
            v197 = c30 * z
            v198 = 0.0
            v200 = 0.0
            v202 = 0.0
            v203 = 0.0
        if levels.outer_house:
            v204 = c35 * v5 + c30 * z
            v217 = 0.0 if east < 0.0 else v204
            v206 = c36 * v5 + c30 * z
            v218 = 0.0 if east > 0.0 else v206
            v219 = c37 * v6 + c38 * v13
            v221 = c39 * (v198 - (v217 - v218))
            v222 = c39 * (v196 - v197 - v219)
        else:
            v217 = c30 * z
            v218 = c30 * z
            v219 = 0.0
            v221 = 0.0
            v222 = 0.0
        v225 = c40 * Y[k, 29] + c41 * z - v9
        v234 = c19 * (v168 + v171) + c44 * (c42 * v182 + c43 * v174) + c45 * z + c2 * v94
        v236 = product(A, B, acc, k, later, 37, v32, v234)
        v237 = product(A, B, acc, k, later, 38, v8, v44)
        v239 = product(A, B, acc, k, later, 39, v8, v43)
        i241 = 1.0 / v29 if k == 0 else i241
        v241 = quotient(A, B, acc, k, later, 40, v29, c47 * (-v236 + c46 * v237) + c48 * v239, i241)
        v242 = product(A, B, acc, k, later, 41, v29, c19 * (v167 + v170) + c44 * (c42 * v181 + c49 * v174) + c2 * v91)
        v243 = product(A, B, acc, k, later, 42, v42, v234)
        v246 = product(A, B, acc, k, later, 43, v30, v44)
        v250 = product(A, B, acc, k, later, 44, v30, v43)
        v251 = c47 * (v242 + c1 * v243 + c50 * v246) + c0 * v250
        v252 = product(A, B, acc, k, later, 45, v37, v241)
        v253 = product(A, B, acc, k, later, 46, v8, v30)
        v254 = c1 * v252 + c1 * v253
        if inputs.ideal_drive:
            v258 = v254 + c40 * z
            v259 = c50 * v258 + c7 * v88
        else:
            v258 = c53 * (c51 * v225 + c52 * v88)
            v259 = c51 * v225
        if levels.inner_house:
            v262 = v202 + c34 * v91
            v263 = v203 + c34 * v94
        else:
            v262 = v202
            v263 = v203
        v264 = v258 - v254
        if levels.outer_house:
            v279 = v217
            v280 = v218
            v281 = v219
        elif levels.inner_house:
            v281 = v196 - v197
            v279 = 0.5 * v198 + c30 * z
            v280 = -0.5 * v198 + c30 * z
        else:
            v279 = -0.5 * v91 + c30 * z
            v280 = 0.5 * v91 + c30 * z
            v281 = -v94
        v282 = v259 + c52 * v88
        v283 = product(A, B, acc, k, later, 47, v44, v259)
        v287 = product(A, B, acc, k, later, 48, v174, c49 * v38 + c43 * v49)
        v288 = product(A, B, acc, k, later, 49, v38, v181)
        v289 = product(A, B, acc, k, later, 50, v49, v182)
        v290 = c42 * v288 + c42 * v289
        if contact.gap_counts_outer == 0.0:
            v294 = 0.0
        else:
            v291 = product(A, B, acc, k, later, 79, v12, v91)
            v292 = product(A, B, acc, k, later, 80, v13, v94)
            v294 = c54 * (v291 + v292)
        v295 = product(A, B, acc, k, later, 51, v38, v170)
        v296 = product(A, B, acc, k, later, 52, v49, v171)
        v297 = v295 + v296
        v298 = product(A, B, acc, k, later, 53, v200, v200)
        v299 = product(A, B, acc, k, later, 54, v13, v13)
        v300 = c33 * v298 + c38 * v299
        v302 = product(A, B, acc, k, later, 55, v71, v83 - v79)
        v303 = product(A, B, acc, k, later, 56, v75, v88)
        v304 = product(A, B, acc, k, later, 57, v29, v236)
        v305 = product(A, B, acc, k, later, 58, v37, v282)
        v306 = -v304 + v305
        v307 = product(A, B, acc, k, later, 59, v32, v242)
        v308 = product(A, B, acc, k, later, 60, v45, v282)
        v309 = v307 - v308
        v310 = product(A, B, acc, k, later, 61, v37, v234)
        v311 = product(A, B, acc, k, later, 62, v31, v242)
        v313 = product(A, B, acc, k, later, 63, v46, v282)
        v314 = v310 + v311 + v313
        v316 = -v91 - (v279 - v280)
        v317 = -v94 - v281
        v318 = Y[k, 31]
        v319 = v80 if contact.viscous_damping == 0.0 else v82
        D[k, 0] = v7
        D[k, 1] = v8
        D[k, 2] = v9
        D[k, 3] = v10
        D[k, 4] = v11
        D[k, 5] = v12
        D[k, 6] = v13
        D[k, 7] = v241
        D[k, 8] = v251
        D[k, 9] = v264
        D[k, 10] = v262
        D[k, 11] = v263
        D[k, 12] = v221
        D[k, 13] = v222
        D[k, 14] = v283
        D[k, 15] = c44 * v287
        D[k, 16] = c44 * v290
        D[k, 17] = v294
        D[k, 18] = 0.0
        D[k, 19] = c22 * v297
        D[k, 20] = v300
        D[k, 21] = v302
        D[k, 22] = v303
        D[k, 23] = v83
        D[k, 24] = v306
        D[k, 25] = v309
        D[k, 26] = v314
        D[k, 27] = v316
        D[k, 28] = v317
        D[k, 29] = z
        D[k, 30] = c55 * v318
        D[k, 31] = c56 * v174
        Y[k, 39] = v83
        Y[k, 40] = 0.0
        Y[k, 41] = v75
        Y[k, 42] = v319
        portion = 1.0 / (k + 1.0)
        for i in range(38):
            Y[k + 1, i] = 0.0
        for j in range(k + 1):
            slow = Y[k - j, 38] * portion
            for i in range(38):
                Y[k + 1, i] += slow * D[j, i]
        Y[k + 1, 38] = 0.5 * v71 * portion
        z, later = 0.0, 1.0
    for i in range(39, 43):
        Y[ORDER, i] = 0.0


@kernel
def rolling(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Rolling: 76 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east = memory[NORTH], memory[EAST]
    c0 = -1.0 * (1.0 if levels.euler else 0.0)
    c1 = (1.0 if levels.euler else 0.0)
    c2 = shaft.arm_ring
    c3 = -1.0 * contact.gap_counts_outer
    c4 = -1.0 * contact.offset_x
    c5 = -1.0 * shaft.arm_ring
    c6 = -1.0 * contact.offset_y
    c7 = -1.0 * contact.clearance
    c8 = shaft.radius
    c9 = contact.exponent
    c10 = contact.stiffness
    c11 = contact.damping_factor / onset
    c12 = contact.viscous_damping
    c13 = shaft.arm_magnet * shaft.arm_magnet
    c14 = magnet.a7
    c15 = magnet.a5
    c16 = magnet.a3
    c17 = shaft.arm_magnet
    c18 = magnet.growth
    c19 = -1.0 * magnet.stiffness
    c20 = -1.0 * shaft.arm_magnet
    c21 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c22 = magnet.number * magnet.ripple * magnet.stiffness
    c23 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c24 = magnet.stiffness * shaft.arm_magnet
    c25 = -1.0 * magnet.damping_x * shaft.arm_magnet
    c26 = -1.0 * magnet.damping_y * shaft.arm_magnet
    c27 = 0.5 * house.pair_stiffness_vertical
    c28 = house.preload
    c29 = -0.5 * house.pair_stiffness_vertical
    c30 = house.inner_beam_stiffness
    c31 = house.inner_beam_damping
    c32 = -1.0 / house.inner_mass
    c33 = 0.5 * house.pair_stiffness_horizontal
    c34 = -0.5 * house.pair_stiffness_horizontal
    c35 = house.outer_beam_stiffness
    c36 = house.outer_beam_damping
    c37 = 1.0 / house.outer_mass
    c38 = inputs.speed_slope
    c39 = aim
    c40 = shaft.unbalance
    c41 = inputs.hammer_force * inputs.hammer_y
    c42 = shaft.arm_disk
    c43 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c44 = -1.0 * shaft.polar_inertia
    c45 = 1.0 / shaft.transverse_inertia
    c46 = 2.0 * (1.0 if levels.euler else 0.0)
    c47 = inputs.hammer_force * inputs.hammer_x
    c48 = shaft.polar_inertia
    c49 = constants.torque_gain
    c50 = -1.0 * shaft.radius
    c51 = 1.0 / shaft.polar_inertia
    c52 = contact.gap_counts_outer
    c53 = pulse
    c54 = -1.0 * pulse
    i66 = 0.0
    i67 = 0.0
    i264 = 0.0
    i363 = 0.0
    Y[0, 29] = 0.0
    Y[0, 30], Y[0, 31] = math.sin(along), math.cos(along)
    Y[0, 32], Y[0, 33] = sines_of(levels, Y[0, 0])
    Y[0, 34], Y[0, 35] = sines_of(levels, Y[0, 1])
    Y[0, 36], Y[0, 37] = math.sin(Y[0, 2] + shaft.unbalance_phase), math.cos(Y[0, 2] + shaft.unbalance_phase)
    wide = is_wide(constants, inputs)
    for p in range(128):
        A[0, p] = B[0, p] = 0.0
    z, later = 1.0, 0.0
    for k in range(ORDER):
        if wide:
            sum_below(A, B, acc, k, 128)
        else:
            sum_below(A, B, acc, k, 76)
        v3 = Y[k, 3]
        v4 = Y[k, 4]
        v5 = Y[k, 5]
        v6 = Y[k, 6]
        v7 = Y[k, 7]
        v8 = Y[k, 8]
        v9 = Y[k, 9]
        v10 = Y[k, 10]
        v11 = Y[k, 11]
        v12 = Y[k, 12]
        v13 = Y[k, 13]
        v29 = Y[k, 35]
        v30 = product(A, B, acc, k, later, 0, v7, v29)
        v31 = Y[k, 32]
        v32 = Y[k, 33]
        v33 = product(A, B, acc, k, later, 1, v7, v32)
        v34 = product(A, B, acc, k, later, 2, v7, v31)
        D[k, 32] = v33
        D[k, 33] = c0 * v34
        v37 = Y[k, 34]
        v38 = product(A, B, acc, k, later, 3, v8, v29)
        v39 = product(A, B, acc, k, later, 4, v8, v37)
        D[k, 34] = v38
        D[k, 35] = c0 * v39
        v42 = product(A, B, acc, k, later, 5, v31, v37)
        v43 = product(A, B, acc, k, later, 6, v7, v37)
        v44 = v9 + c1 * v43
        v45 = product(A, B, acc, k, later, 7, v29, v31)
        v46 = product(A, B, acc, k, later, 8, v29, v32)
        v47 = product(A, B, acc, k, later, 9, v30, v32)
        v48 = product(A, B, acc, k, later, 10, v31, v39)
        v49 = -v47 + c1 * v48
        v52 = c2 * v37 - v3 + c3 * v5 + c4 * z
        v55 = c5 * v45 - v4 + c3 * v6 + c6 * z
        v57 = c2 * v38 - v10 + c3 * v12
        v59 = c2 * v49 - v11 + c3 * v13
        v60 = product(A, B, acc, k, later, 11, v52, v52)
        v61 = product(A, B, acc, k, later, 12, v55, v55)
        v62 = v60 + v61
        v63 = math.sqrt(v62) if k == 0 else (v62 - acc[13]) * (0.5 / A[0, 13])
        A[k, 13] = B[k, 13] = v63
        v64 = v63 + c7 * z
        i66 = 1.0 / v63 if k == 0 else i66
        v66 = quotient(A, B, acc, k, later, 14, v63, v52, i66)
        i67 = 1.0 / v63 if k == 0 else i67
        v67 = quotient(A, B, acc, k, later, 15, v63, v55, i67)
        v68 = product(A, B, acc, k, later, 16, v57, v66)
        v69 = product(A, B, acc, k, later, 17, v59, v67)
        v70 = v68 + v69
        v71 = product(A, B, acc, k, later, 18, v59, v66)
        v72 = product(A, B, acc, k, later, 19, v57, v67)
        v73 = v71 - v72
        v74 = v73 + c8 * v44
        if contact.exponent == 1.5:
            v75 = math.sqrt(v64) if k == 0 else (v64 - acc[20]) * (0.5 / A[0, 20])
            A[k, 20] = B[k, 20] = v75
            v76 = product(A, B, acc, k, later, 21, v64, v75)
            v79 = c10 * v76
        elif contact.exponent == 1.0:
            v79 = c10 * v64
        else:
            v77 = v64 ** c9 if k == 0 else (c9 * (acc[76] + k * v64 * B[0, 76]) - acc[77]) / (k * B[0, 77])
            A[k, 76], B[k, 76], A[k, 77], B[k, 77] = k * v64, v77, k * v77, v64
            v79 = c10 * v77
        v81 = product(A, B, acc, k, later, 22, v79, c11 * v70 + z)
        v82 = v81 + c12 * v70
        v83 = 0.0 if slack else v82
        v84 = product(A, B, acc, k, later, 23, v66, v83)
        v85 = product(A, B, acc, k, later, 24, v67, v83)
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v158 = c23 * v37
                v159 = c24 * v45
            elif magnet.terms == RADIAL:
                v106 = product(A, B, acc, k, later, 25, v37, v37)
                v107 = product(A, B, acc, k, later, 26, v45, v45)
                v108 = c13 * v106 + c13 * v107
                v110 = product(A, B, acc, k, later, 27, v108, c14 * v108 + c15 * z)
                v112 = product(A, B, acc, k, later, 28, v108, v110 + c16 * z)
                v113 = v112 + z
                v120 = product(A, B, acc, k, later, 29, v37, v113)
                v121 = product(A, B, acc, k, later, 30, v45, v113)
                v158 = c23 * v120
                v159 = c24 * v121
            else:
                v122 = product(A, B, acc, k, later, 78, v37, v37)
                v123 = product(A, B, acc, k, later, 79, v45, v45)
                v124 = c13 * v122 + c13 * v123
                v126 = product(A, B, acc, k, later, 80, v124, c14 * v124 + c15 * z)
                v128 = product(A, B, acc, k, later, 81, v124, v126 + c16 * z)
                power_x, power_y = complex_power(A, B, acc, k, later, 90, c17 * v45, c17 * v37, int((magnet.number + -1.0)))
                v137 = power_x
                v138 = power_y
                v139 = product(A, B, acc, k, later, 82, v45, v137)
                v140 = product(A, B, acc, k, later, 83, v37, v138)
                v142 = c18 * v124 + z
                v143 = c19 * (v128 + z) + c21 * (c17 * v139 + c20 * v140)
                v144 = product(A, B, acc, k, later, 84, v37, v143)
                v145 = product(A, B, acc, k, later, 85, v138, v142)
                v158 = c17 * v144 + c22 * v145
                v147 = product(A, B, acc, k, later, 86, v45, v143)
                v148 = product(A, B, acc, k, later, 87, v137, v142)
                v159 = c20 * v147 + c22 * v148
            v161 = c25 * v38
            v162 = c26 * v49
        else:
            v158 = 0.0
            v159 = 0.0
            v161 = 0.0
            v162 = 0.0
        v165 = Y[k, 30]
        v168 = product(A, B, acc, k, later, 31, v9, Y[k, 37])
        v169 = product(A, B, acc, k, later, 32, v9, Y[k, 36])
        D[k, 36] = v168
        D[k, 37] = -v169
        v172 = product(A, B, acc, k, later, 33, v9, v168)
        v173 = product(A, B, acc, k, later, 34, v9, v169)
        if levels.inner_house:
            v174 = v4 - v6
            v175 = c27 * v174 + c28 * z
            v187 = 0.0 if north < 0.0 else v175
            v177 = c29 * v174 + c28 * z
            v188 = 0.0 if north > 0.0 else v177
            v191 = v10 - v12
            v189 = c30 * (v3 - v5) + c31 * v191
            v193 = c32 * v189
            v194 = c32 * (v187 - v188)
        else:
            v187 = c28 * z
            v188 = c28 * z
            v189 = 0.0
            v191 = 0.0
            v193 = 0.0
            v194 = 0.0
        if levels.outer_house:
            v195 = c33 * v5 + c28 * z
            v208 = 0.0 if east < 0.0 else v195
            v197 = c34 * v5 + c28 * z
            v209 = 0.0 if east > 0.0 else v197
            v210 = c35 * v6 + c36 * v13
            v212 = c37 * (v189 - (v208 - v209))
            v213 = c37 * (v187 - v188 - v210)
        else:
            v208 = c28 * z
            v209 = c28 * z
            v210 = 0.0
            v212 = 0.0
            v213 = 0.0
        v216 = c38 * Y[k, 29] + c39 * z - v9
        v228 = product(A, B, acc, k, later, 35, v8, v44)
        v230 = product(A, B, acc, k, later, 36, v8, v43)
        v237 = product(A, B, acc, k, later, 37, v30, v44)
        v239 = product(A, B, acc, k, later, 38, v7, v7)
        v241 = product(A, B, acc, k, later, 39, v30, v43)
        v244 = product(A, B, acc, k, later, 40, v8, v30)
        v254 = 0.0
        v255 = product(A, B, acc, k, later, 41, v67, v254)
        v256 = -v84 + v255
        v257 = product(A, B, acc, k, later, 42, v66, v254)
        v258 = -v85 - v257
        v260 = c17 * (v159 + v162) + c42 * (c40 * v173 + c41 * v165) + c43 * z + c2 * v258
        v261 = product(A, B, acc, k, later, 43, v32, v260)
        i264 = 1.0 / v29 if k == 0 else i264
        v264 = quotient(A, B, acc, k, later, 44, v29, c45 * (-v261 + c44 * v228) + c46 * v230, i264)
        v265 = product(A, B, acc, k, later, 45, v29, c17 * (v158 + v161) + c42 * (c40 * v172 + c47 * v165) + c2 * v256)
        v266 = product(A, B, acc, k, later, 46, v42, v260)
        v269 = c45 * (v265 + c1 * v266 + c48 * v237) + c0 * v241
        v270 = product(A, B, acc, k, later, 47, v37, v264)
        v271 = c1 * v270 + c1 * v244
        if inputs.ideal_drive:
            v275 = v271 + c38 * z
        else:
            v275 = c51 * (c49 * v216 + c50 * v254)
        if levels.inner_house:
            v279 = v193 + c32 * v256
            v280 = v194 + c32 * v258
        else:
            v279 = v193
            v280 = v194
        if levels.outer_house:
            pass
        elif levels.inner_house:
            v282 = v187 - v188
            v283 = 0.5 * v189 + c28 * z
            v284 = -0.5 * v189 + c28 * z
        v304 = product(A, B, acc, k, later, 49, v165, c47 * v38 + c41 * v49)
        v305 = product(A, B, acc, k, later, 50, v38, v172)
        v306 = product(A, B, acc, k, later, 51, v49, v173)
        v307 = c40 * v305 + c40 * v306
        v312 = product(A, B, acc, k, later, 52, v38, v161)
        v313 = product(A, B, acc, k, later, 53, v49, v162)
        v314 = v312 + v313
        v315 = product(A, B, acc, k, later, 54, v191, v191)
        v316 = product(A, B, acc, k, later, 55, v13, v13)
        v317 = c31 * v315 + c36 * v316
        v319 = product(A, B, acc, k, later, 56, v70, v83 - v79)
        v335 = product(A, B, acc, k, later, 65, v8, v8)
        v337 = product(A, B, acc, k, later, 66, v29, v269)
        v338 = product(A, B, acc, k, later, 67, v37, v335)
        v340 = product(A, B, acc, k, later, 68, v46, v264)
        v341 = product(A, B, acc, k, later, 69, v42, v269)
        v343 = product(A, B, acc, k, later, 70, v45, v239 + v335)
        v346 = product(A, B, acc, k, later, 71, v33, v39)
        v359 = product(A, B, acc, k, later, 72, v66, c2 * (-v340 + c1 * v341 + c1 * v343 + c46 * v346) - v280 + c3 * v213)
        v360 = product(A, B, acc, k, later, 73, v67, c2 * (v337 + c0 * v338) - v279 + c3 * v212)
        v362 = product(A, B, acc, k, later, 74, v70, v73)
        i363 = 1.0 / v63 if k == 0 else i363
        v363 = quotient(A, B, acc, k, later, 75, v63, v362, i363)
        v365 = v359 - v360 - v363 + c8 * v275
        v366 = Y[k, 31]
        friction = v365 * per_friction
        v254 = friction
        v255 = product(A, B, acc, k, later, 41, v67, v254)
        v256 = -v84 + v255
        v257 = product(A, B, acc, k, later, 42, v66, v254)
        v258 = -v85 - v257
        v260 = c17 * (v159 + v162) + c42 * (c40 * v173 + c41 * v165) + c43 * z + c2 * v258
        v261 = product(A, B, acc, k, later, 43, v32, v260)
        i264 = 1.0 / v29 if k == 0 else i264
        v264 = quotient(A, B, acc, k, later, 44, v29, c45 * (-v261 + c44 * v228) + c46 * v230, i264)
        v265 = product(A, B, acc, k, later, 45, v29, c17 * (v158 + v161) + c42 * (c40 * v172 + c47 * v165) + c2 * v256)
        v266 = product(A, B, acc, k, later, 46, v42, v260)
        v269 = c45 * (v265 + c1 * v266 + c48 * v237) + c0 * v241
        v270 = product(A, B, acc, k, later, 47, v37, v264)
        v271 = c1 * v270 + c1 * v244
        if inputs.ideal_drive:
            v275 = v271 + c38 * z
            v276 = c48 * v275 + c8 * v254
        else:
            v275 = c51 * (c49 * v216 + c50 * v254)
            v276 = c49 * v216
        if levels.inner_house:
            v279 = v193 + c32 * v256
            v280 = v194 + c32 * v258
        else:
            v279 = v193
            v280 = v194
        v281 = v275 - v271
        if levels.outer_house:
            v296 = v208
            v297 = v209
            v298 = v210
        elif levels.inner_house:
            v296 = v283
            v297 = v284
            v298 = v282
        else:
            v296 = -0.5 * v256 + c28 * z
            v297 = 0.5 * v256 + c28 * z
            v298 = -v258
        v299 = v276 + c50 * v254
        v300 = product(A, B, acc, k, later, 48, v44, v276)
        if contact.gap_counts_outer == 0.0:
            v311 = 0.0
        else:
            v308 = product(A, B, acc, k, later, 88, v12, v256)
            v309 = product(A, B, acc, k, later, 89, v13, v258)
            v311 = c52 * (v308 + v309)
        v320 = product(A, B, acc, k, later, 57, v74, v254)
        v321 = product(A, B, acc, k, later, 58, v29, v261)
        v322 = product(A, B, acc, k, later, 59, v37, v299)
        v323 = -v321 + v322
        v324 = product(A, B, acc, k, later, 60, v32, v265)
        v325 = product(A, B, acc, k, later, 61, v45, v299)
        v326 = v324 - v325
        v327 = product(A, B, acc, k, later, 62, v37, v260)
        v328 = product(A, B, acc, k, later, 63, v31, v265)
        v330 = product(A, B, acc, k, later, 64, v46, v299)
        v331 = v327 + v328 + v330
        v333 = -v256 - (v296 - v297)
        v334 = -v258 - v298
        v337 = product(A, B, acc, k, later, 66, v29, v269)
        v340 = product(A, B, acc, k, later, 68, v46, v264)
        v341 = product(A, B, acc, k, later, 69, v42, v269)
        v359 = product(A, B, acc, k, later, 72, v66, c2 * (-v340 + c1 * v341 + c1 * v343 + c46 * v346) - v280 + c3 * v213)
        v360 = product(A, B, acc, k, later, 73, v67, c2 * (v337 + c0 * v338) - v279 + c3 * v212)
        v365 = v359 - v360 - v363 + c8 * v275
        D[k, 0] = v7
        D[k, 1] = v8
        D[k, 2] = v9
        D[k, 3] = v10
        D[k, 4] = v11
        D[k, 5] = v12
        D[k, 6] = v13
        D[k, 7] = v264
        D[k, 8] = v269
        D[k, 9] = v281
        D[k, 10] = v279
        D[k, 11] = v280
        D[k, 12] = v212
        D[k, 13] = v213
        D[k, 14] = v300
        D[k, 15] = c42 * v304
        D[k, 16] = c42 * v307
        D[k, 17] = v311
        D[k, 18] = 0.0
        D[k, 19] = c20 * v314
        D[k, 20] = v317
        D[k, 21] = v319
        D[k, 22] = v320
        D[k, 23] = v83
        D[k, 24] = v323
        D[k, 25] = v326
        D[k, 26] = v331
        D[k, 27] = v333
        D[k, 28] = v334
        D[k, 29] = z
        D[k, 30] = c53 * v366
        D[k, 31] = c54 * v165
        Y[k, 39] = v83
        Y[k, 40] = v64
        Y[k, 41] = v254
        Y[k, 42] = 0.0
        portion = 1.0 / (k + 1.0)
        for i in range(38):
            Y[k + 1, i] = D[k, i] * portion
        Y[k + 1, 38] = 0.0
        z, later = 0.0, 1.0
    for i in range(39, 43):
        Y[ORDER, i] = 0.0
