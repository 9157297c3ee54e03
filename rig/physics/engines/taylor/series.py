"""Coefficients of the Taylor series, by phase.

Made by `NUMBA_DISABLE_JIT=1 python -m rig.physics.engines.tape.taylor`: do not edit; tests/physics/test_taylor.py
compares it.
"""

# pyright: reportPossiblyUnboundVariable=false

from __future__ import annotations

import math

from rig.physics.engines.common.memory import ONSET, PHASE
from rig.physics.engines.taylor.lanes import complex_power, is_wide, product, quotient, sum_below
from rig.physics.engines.taylor.place import EAST, NORTH, SLACK
from rig.physics.kernels.laws.contact import BACKWARD, EXACT, FLIGHT, FORWARD  # noqa: F401
from rig.physics.kernels.laws.contact import NO_FRICTION, ROLLING, SMOOTHED, TOUCHING  # noqa: F401
from rig.physics.kernels.frames.geometry import sines_of
from rig.physics.kernels.laws.magnet import LINEAR, RADIAL, RIPPLED  # noqa: F401
from rig.physics.kernels.stage import kernel


LANES = 128


@kernel
def flight(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Flight: 48 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east, order = memory[NORTH], memory[EAST], len(Y) - 1
    c0 = (1.0 if levels.euler else 0.0)
    c1 = shaft.arm_magnet * shaft.arm_magnet
    c2 = 2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c3 = magnet.number * magnet.ripple * magnet.stiffness
    c4 = 0.5 * house.pair_stiffness_vertical
    c5 = 0.5 * house.pair_stiffness_horizontal
    c6 = inputs.hammer_force * inputs.hammer_x
    c7 = inputs.hammer_force * inputs.hammer_y
    c8 = shaft.arm_centre * shaft.gravity * shaft.mass
    c9 = 1.0 / shaft.transverse_inertia
    c10 = 2.0 * (1.0 if levels.euler else 0.0)
    c11 = magnet.stiffness * shaft.arm_magnet
    c12 = magnet.damping_x * shaft.arm_magnet
    c13 = magnet.damping_y * shaft.arm_magnet
    c14 = 1.0 / house.inner_mass
    c15 = 1.0 / house.outer_mass
    c16 = constants.torque_gain / shaft.polar_inertia
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
    for k in range(order):
        if wide:
            sum_below(A, B, acc, k, 96)
        else:
            sum_below(A, B, acc, k, 48)
        v30 = product(A, B, acc, k, later, 0, Y[k, 7], Y[k, 35])
        D[k, 32] = product(A, B, acc, k, later, 1, Y[k, 7], Y[k, 33])
        D[k, 33] = -c0 * product(A, B, acc, k, later, 2, Y[k, 7], Y[k, 32])
        v38 = product(A, B, acc, k, later, 3, Y[k, 8], Y[k, 35])
        v39 = product(A, B, acc, k, later, 4, Y[k, 8], Y[k, 34])
        D[k, 34] = v38
        D[k, 35] = -c0 * v39
        v42 = product(A, B, acc, k, later, 5, Y[k, 32], Y[k, 34])
        v43 = product(A, B, acc, k, later, 6, Y[k, 7], Y[k, 34])
        v44 = Y[k, 9] + c0 * v43
        v45 = product(A, B, acc, k, later, 7, Y[k, 35], Y[k, 32])
        v46 = product(A, B, acc, k, later, 8, Y[k, 35], Y[k, 33])
        v48 = product(A, B, acc, k, later, 10, Y[k, 32], v39)
        v49 = -product(A, B, acc, k, later, 9, v30, Y[k, 33]) + c0 * v48
        v52 = shaft.arm_ring * Y[k, 34] - Y[k, 3] - contact.gap_counts_outer * Y[k, 5] - contact.offset_x * z
        v55 = -shaft.arm_ring * v45 - Y[k, 4] - contact.gap_counts_outer * Y[k, 6] - contact.offset_y * z
        v62 = product(A, B, acc, k, later, 11, v52, v52) + product(A, B, acc, k, later, 12, v55, v55)
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v147 = -c11 * Y[k, 34]
                v148 = c11 * v45
            elif magnet.terms == RADIAL:
                v96 = product(A, B, acc, k, later, 14, v45, v45)
                v97 = c1 * product(A, B, acc, k, later, 13, Y[k, 34], Y[k, 34]) + c1 * v96
                v100 = product(A, B, acc, k, later, 15, v97, magnet.a7 * v97 + magnet.a5 * z) + magnet.a3 * z
                v102 = product(A, B, acc, k, later, 16, v97, v100) + z
                v147 = -c11 * product(A, B, acc, k, later, 17, Y[k, 34], v102)
                v148 = c11 * product(A, B, acc, k, later, 18, v45, v102)
            else:
                v112 = product(A, B, acc, k, later, 49, v45, v45)
                v113 = c1 * product(A, B, acc, k, later, 48, Y[k, 34], Y[k, 34]) + c1 * v112
                v116 = product(A, B, acc, k, later, 50, v113, magnet.a7 * v113 + magnet.a5 * z) + magnet.a3 * z
                power_x, power_y = complex_power(
                    A, B, acc, k, later, 58, shaft.arm_magnet * v45, shaft.arm_magnet * Y[k, 34], int((magnet.number + -1.0))
                )
                v126 = power_x
                v127 = power_y
                v129 = product(A, B, acc, k, later, 53, Y[k, 34], v127)
                v130 = shaft.arm_magnet * product(A, B, acc, k, later, 52, v45, v126) - shaft.arm_magnet * v129
                v131 = magnet.growth * v113 + z
                v132 = -magnet.stiffness * (product(A, B, acc, k, later, 51, v113, v116) + z) - c2 * v130
                v134 = product(A, B, acc, k, later, 55, v127, v131)
                v147 = shaft.arm_magnet * product(A, B, acc, k, later, 54, Y[k, 34], v132) + c3 * v134
                v137 = product(A, B, acc, k, later, 57, v126, v131)
                v148 = -shaft.arm_magnet * product(A, B, acc, k, later, 56, v45, v132) + c3 * v137
            v150 = -c12 * v38
            v151 = -c13 * v49
        else:
            v147 = 0.0
            v148 = 0.0
            v150 = 0.0
            v151 = 0.0
        v157 = product(A, B, acc, k, later, 19, Y[k, 9], Y[k, 37])
        v158 = product(A, B, acc, k, later, 20, Y[k, 9], Y[k, 36])
        D[k, 36] = v157
        D[k, 37] = -v158
        v161 = product(A, B, acc, k, later, 21, Y[k, 9], v157)
        v162 = product(A, B, acc, k, later, 22, Y[k, 9], v158)
        if levels.inner_house:
            v163 = Y[k, 4] - Y[k, 6]
            v176 = 0.0 if north < 0.0 else c4 * v163 + house.preload * z
            v177 = 0.0 if north > 0.0 else -c4 * v163 + house.preload * z
            v180 = Y[k, 10] - Y[k, 12]
            v178 = house.inner_beam_stiffness * (Y[k, 3] - Y[k, 5]) + house.inner_beam_damping * v180
            v182 = -c14 * v178
            v183 = -c14 * (v176 - v177)
        else:
            v176 = house.preload * z
            v177 = house.preload * z
            v178 = 0.0
            v180 = 0.0
            v182 = 0.0
            v183 = 0.0
        if levels.outer_house:
            v197 = 0.0 if east < 0.0 else c5 * Y[k, 5] + house.preload * z
            v198 = 0.0 if east > 0.0 else -c5 * Y[k, 5] + house.preload * z
            v199 = house.outer_beam_stiffness * Y[k, 6] + house.outer_beam_damping * Y[k, 13]
            v201 = c15 * (v178 - (v197 - v198))
            v202 = c15 * (v176 - v177 - v199)
        else:
            v197 = house.preload * z
            v198 = house.preload * z
            v199 = 0.0
            v201 = 0.0
            v202 = 0.0
        v205 = inputs.speed_slope * Y[k, 29] + aim * z - Y[k, 9]
        v208 = shaft.arm_magnet * (v147 + v150) + shaft.arm_disk * (shaft.unbalance * v161 + c6 * Y[k, 30])
        v211 = shaft.arm_magnet * (v148 + v151) + shaft.arm_disk * (shaft.unbalance * v162 + c7 * Y[k, 30])
        v212 = v211 - c8 * z
        v214 = product(A, B, acc, k, later, 23, Y[k, 33], v212)
        v217 = product(A, B, acc, k, later, 25, Y[k, 8], v43)
        v218 = c9 * (-v214 - shaft.polar_inertia * product(A, B, acc, k, later, 24, Y[k, 8], v44)) + c10 * v217
        i219 = 1.0 / Y[k, 35] if k == 0 else i219
        v219 = quotient(A, B, acc, k, later, 26, Y[k, 35], v218, i219)
        v220 = product(A, B, acc, k, later, 27, Y[k, 35], v208)
        v224 = product(A, B, acc, k, later, 29, v30, v44)
        v225 = v220 + c0 * product(A, B, acc, k, later, 28, v42, v212) + shaft.polar_inertia * v224
        v229 = c9 * v225 - c0 * product(A, B, acc, k, later, 30, v30, v43)
        v231 = product(A, B, acc, k, later, 32, Y[k, 8], v30)
        v232 = c0 * product(A, B, acc, k, later, 31, Y[k, 34], v219) + c0 * v231
        if inputs.ideal_drive:
            v234 = v232 + inputs.speed_slope * z
            v235 = shaft.polar_inertia * v234
        else:
            v234 = c16 * v205
            v235 = constants.torque_gain * v205
        v236 = v234 - v232
        if levels.outer_house:
            v247 = v197
            v248 = v198
            v249 = v199
        elif levels.inner_house:
            v249 = v176 - v177
            v247 = 0.5 * v178 + house.preload * z
            v248 = -0.5 * v178 + house.preload * z
        else:
            v247 = house.preload * z
            v248 = house.preload * z
            v249 = 0.0
        v250 = product(A, B, acc, k, later, 33, v44, v235)
        v254 = product(A, B, acc, k, later, 34, Y[k, 30], c6 * v38 + c7 * v49)
        v256 = product(A, B, acc, k, later, 36, v49, v162)
        v257 = shaft.unbalance * product(A, B, acc, k, later, 35, v38, v161) + shaft.unbalance * v256
        v260 = product(A, B, acc, k, later, 37, v38, v150) + product(A, B, acc, k, later, 38, v49, v151)
        v261 = product(A, B, acc, k, later, 39, v180, v180)
        v262 = product(A, B, acc, k, later, 40, Y[k, 13], Y[k, 13])
        v263 = house.inner_beam_damping * v261 + house.outer_beam_damping * v262
        v265 = product(A, B, acc, k, later, 42, Y[k, 34], v235)
        v266 = -product(A, B, acc, k, later, 41, Y[k, 35], v214) + v265
        v269 = product(A, B, acc, k, later, 43, Y[k, 33], v220) - product(A, B, acc, k, later, 44, v45, v235)
        v271 = product(A, B, acc, k, later, 46, Y[k, 32], v220)
        v273 = product(A, B, acc, k, later, 47, v46, v235)
        v274 = product(A, B, acc, k, later, 45, Y[k, 34], v212) + v271 + v273
        v275 = v247 - v248
        D[k, 0] = Y[k, 7]
        D[k, 1] = Y[k, 8]
        D[k, 2] = Y[k, 9]
        D[k, 3] = Y[k, 10]
        D[k, 4] = Y[k, 11]
        D[k, 5] = Y[k, 12]
        D[k, 6] = Y[k, 13]
        D[k, 7] = v219
        D[k, 8] = v229
        D[k, 9] = v236
        D[k, 10] = v182
        D[k, 11] = v183
        D[k, 12] = v201
        D[k, 13] = v202
        D[k, 14] = v250
        D[k, 15] = shaft.arm_disk * v254
        D[k, 16] = shaft.arm_disk * v257
        D[k, 17] = 0.0
        D[k, 18] = 0.0
        D[k, 19] = -shaft.arm_magnet * v260
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
        D[k, 30] = pulse * Y[k, 31]
        D[k, 31] = -pulse * Y[k, 30]
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
        Y[order, i] = 0.0


@kernel
def sliding(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Sliding: 64 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east, order = memory[NORTH], memory[EAST], len(Y) - 1
    c0 = (1.0 if levels.euler else 0.0)
    c1 = shaft.arm_magnet * shaft.arm_magnet
    c2 = 2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c3 = magnet.number * magnet.ripple * magnet.stiffness
    c4 = 0.5 * house.pair_stiffness_vertical
    c5 = 0.5 * house.pair_stiffness_horizontal
    c6 = inputs.hammer_force * inputs.hammer_x
    c7 = inputs.hammer_force * inputs.hammer_y
    c8 = shaft.arm_centre * shaft.gravity * shaft.mass
    c9 = 1.0 / shaft.transverse_inertia
    c10 = 2.0 * (1.0 if levels.euler else 0.0)
    c11 = 2.0 * contact.exponent
    c12 = contact.damping_factor / onset
    c13 = 1.0 / contact.smoothing_speed
    c14 = magnet.stiffness * shaft.arm_magnet
    c15 = magnet.damping_x * shaft.arm_magnet
    c16 = magnet.damping_y * shaft.arm_magnet
    c17 = 1.0 / house.inner_mass
    c18 = 1.0 / house.outer_mass
    c19 = 1.0 / shaft.polar_inertia
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
    for k in range(order):
        if wide:
            sum_below(A, B, acc, k, 120)
        else:
            sum_below(A, B, acc, k, 64)
        v30 = product(A, B, acc, k, later, 0, Y[k, 7], Y[k, 35])
        D[k, 32] = product(A, B, acc, k, later, 1, Y[k, 7], Y[k, 33])
        D[k, 33] = -c0 * product(A, B, acc, k, later, 2, Y[k, 7], Y[k, 32])
        v38 = product(A, B, acc, k, later, 3, Y[k, 8], Y[k, 35])
        v39 = product(A, B, acc, k, later, 4, Y[k, 8], Y[k, 34])
        D[k, 34] = v38
        D[k, 35] = -c0 * v39
        v42 = product(A, B, acc, k, later, 5, Y[k, 32], Y[k, 34])
        v43 = product(A, B, acc, k, later, 6, Y[k, 7], Y[k, 34])
        v44 = Y[k, 9] + c0 * v43
        v45 = product(A, B, acc, k, later, 7, Y[k, 35], Y[k, 32])
        v46 = product(A, B, acc, k, later, 8, Y[k, 35], Y[k, 33])
        v48 = product(A, B, acc, k, later, 10, Y[k, 32], v39)
        v49 = -product(A, B, acc, k, later, 9, v30, Y[k, 33]) + c0 * v48
        v52 = shaft.arm_ring * Y[k, 34] - Y[k, 3] - contact.gap_counts_outer * Y[k, 5] - contact.offset_x * z
        v55 = -shaft.arm_ring * v45 - Y[k, 4] - contact.gap_counts_outer * Y[k, 6] - contact.offset_y * z
        v57 = shaft.arm_ring * v38 - Y[k, 10] - contact.gap_counts_outer * Y[k, 12]
        v59 = shaft.arm_ring * v49 - Y[k, 11] - contact.gap_counts_outer * Y[k, 13]
        v62 = product(A, B, acc, k, later, 11, v52, v52) + product(A, B, acc, k, later, 12, v55, v55)
        v63 = math.sqrt(v62) if k == 0 else (v62 - acc[13]) * (0.5 / A[0, 13])
        A[k, 13] = B[k, 13] = v63
        v65 = product(A, B, acc, k, later, 14, Y[k, 38], Y[k, 38])
        i67 = 1.0 / v63 if k == 0 else i67
        v67 = quotient(A, B, acc, k, later, 15, v63, v52, i67)
        i68 = 1.0 / v63 if k == 0 else i68
        v68 = quotient(A, B, acc, k, later, 16, v63, v55, i68)
        v71 = product(A, B, acc, k, later, 17, v57, v67) + product(A, B, acc, k, later, 18, v59, v68)
        v74 = product(A, B, acc, k, later, 19, v59, v67) - product(A, B, acc, k, later, 20, v57, v68)
        v75 = v74 + shaft.radius * v44
        if contact.exponent == 1.5:
            v79 = contact.stiffness * product(A, B, acc, k, later, 21, Y[k, 38], v65)
        elif contact.exponent == 1.0:
            v79 = contact.stiffness * v65
        else:
            v77 = Y[k, 38] ** c11 if k == 0 else (c11 * (acc[64] + k * Y[k, 38] * B[0, 64]) - acc[65]) / (k * B[0, 65])
            A[k, 64], B[k, 64], A[k, 65], B[k, 65] = k * Y[k, 38], v77, k * v77, Y[k, 38]
            v79 = contact.stiffness * v77
        v80 = c12 * v71 + z
        v82 = product(A, B, acc, k, later, 22, v79, v80) + contact.viscous_damping * v71
        v83 = 0.0 if slack else v82
        if phase == FORWARD:
            v88 = contact.friction * v83
        elif phase == BACKWARD:
            v88 = -contact.friction * v83
        elif levels.friction == SMOOTHED:
            v84 = math.tanh(c13 * v75) if k == 0 else (acc[66] + k * (c13 * v75) * B[0, 66]) / k
            A[k, 66] = k * (c13 * v75)
            B[k, 66] = z - product(A, B, acc, k, later, 67, v84, v84)
            v88 = contact.friction * product(A, B, acc, k, later, 68, v83, v84)
        else:
            v88 = 0.0
        v91 = -product(A, B, acc, k, later, 23, v67, v83) + product(A, B, acc, k, later, 24, v68, v88)
        v94 = -product(A, B, acc, k, later, 25, v68, v83) - product(A, B, acc, k, later, 26, v67, v88)
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v167 = -c14 * Y[k, 34]
                v168 = c14 * v45
            elif magnet.terms == RADIAL:
                v116 = product(A, B, acc, k, later, 28, v45, v45)
                v117 = c1 * product(A, B, acc, k, later, 27, Y[k, 34], Y[k, 34]) + c1 * v116
                v120 = product(A, B, acc, k, later, 29, v117, magnet.a7 * v117 + magnet.a5 * z) + magnet.a3 * z
                v122 = product(A, B, acc, k, later, 30, v117, v120) + z
                v167 = -c14 * product(A, B, acc, k, later, 31, Y[k, 34], v122)
                v168 = c14 * product(A, B, acc, k, later, 32, v45, v122)
            else:
                v132 = product(A, B, acc, k, later, 70, v45, v45)
                v133 = c1 * product(A, B, acc, k, later, 69, Y[k, 34], Y[k, 34]) + c1 * v132
                v136 = product(A, B, acc, k, later, 71, v133, magnet.a7 * v133 + magnet.a5 * z) + magnet.a3 * z
                power_x, power_y = complex_power(
                    A, B, acc, k, later, 81, shaft.arm_magnet * v45, shaft.arm_magnet * Y[k, 34], int((magnet.number + -1.0))
                )
                v146 = power_x
                v147 = power_y
                v149 = product(A, B, acc, k, later, 74, Y[k, 34], v147)
                v150 = shaft.arm_magnet * product(A, B, acc, k, later, 73, v45, v146) - shaft.arm_magnet * v149
                v151 = magnet.growth * v133 + z
                v152 = -magnet.stiffness * (product(A, B, acc, k, later, 72, v133, v136) + z) - c2 * v150
                v154 = product(A, B, acc, k, later, 76, v147, v151)
                v167 = shaft.arm_magnet * product(A, B, acc, k, later, 75, Y[k, 34], v152) + c3 * v154
                v157 = product(A, B, acc, k, later, 78, v146, v151)
                v168 = -shaft.arm_magnet * product(A, B, acc, k, later, 77, v45, v152) + c3 * v157
            v170 = -c15 * v38
            v171 = -c16 * v49
        else:
            v167 = 0.0
            v168 = 0.0
            v170 = 0.0
            v171 = 0.0
        v177 = product(A, B, acc, k, later, 33, Y[k, 9], Y[k, 37])
        v178 = product(A, B, acc, k, later, 34, Y[k, 9], Y[k, 36])
        D[k, 36] = v177
        D[k, 37] = -v178
        v181 = product(A, B, acc, k, later, 35, Y[k, 9], v177)
        v182 = product(A, B, acc, k, later, 36, Y[k, 9], v178)
        if levels.inner_house:
            v183 = Y[k, 4] - Y[k, 6]
            v196 = 0.0 if north < 0.0 else c4 * v183 + house.preload * z
            v197 = 0.0 if north > 0.0 else -c4 * v183 + house.preload * z
            v200 = Y[k, 10] - Y[k, 12]
            v198 = house.inner_beam_stiffness * (Y[k, 3] - Y[k, 5]) + house.inner_beam_damping * v200
            v202 = -c17 * v198
            v203 = -c17 * (v196 - v197)
        else:
            v196 = house.preload * z
            v197 = house.preload * z
            v198 = 0.0
            v200 = 0.0
            v202 = 0.0
            v203 = 0.0
        if levels.outer_house:
            v217 = 0.0 if east < 0.0 else c5 * Y[k, 5] + house.preload * z
            v218 = 0.0 if east > 0.0 else -c5 * Y[k, 5] + house.preload * z
            v219 = house.outer_beam_stiffness * Y[k, 6] + house.outer_beam_damping * Y[k, 13]
            v221 = c18 * (v198 - (v217 - v218))
            v222 = c18 * (v196 - v197 - v219)
        else:
            v217 = house.preload * z
            v218 = house.preload * z
            v219 = 0.0
            v221 = 0.0
            v222 = 0.0
        v225 = inputs.speed_slope * Y[k, 29] + aim * z - Y[k, 9]
        v228 = shaft.arm_magnet * (v167 + v170) + shaft.arm_disk * (shaft.unbalance * v181 + c6 * Y[k, 30])
        v231 = shaft.arm_magnet * (v168 + v171) + shaft.arm_disk * (shaft.unbalance * v182 + c7 * Y[k, 30])
        v234 = v231 - c8 * z + shaft.arm_ring * v94
        v236 = product(A, B, acc, k, later, 37, Y[k, 33], v234)
        v239 = product(A, B, acc, k, later, 39, Y[k, 8], v43)
        v240 = c9 * (-v236 - shaft.polar_inertia * product(A, B, acc, k, later, 38, Y[k, 8], v44)) + c10 * v239
        i241 = 1.0 / Y[k, 35] if k == 0 else i241
        v241 = quotient(A, B, acc, k, later, 40, Y[k, 35], v240, i241)
        v242 = product(A, B, acc, k, later, 41, Y[k, 35], v228 + shaft.arm_ring * v91)
        v246 = product(A, B, acc, k, later, 43, v30, v44)
        v247 = v242 + c0 * product(A, B, acc, k, later, 42, v42, v234) + shaft.polar_inertia * v246
        v251 = c9 * v247 - c0 * product(A, B, acc, k, later, 44, v30, v43)
        v253 = product(A, B, acc, k, later, 46, Y[k, 8], v30)
        v254 = c0 * product(A, B, acc, k, later, 45, Y[k, 34], v241) + c0 * v253
        if inputs.ideal_drive:
            v258 = v254 + inputs.speed_slope * z
            v259 = shaft.polar_inertia * v258 + shaft.radius * v88
        else:
            v258 = c19 * (constants.torque_gain * v225 - shaft.radius * v88)
            v259 = constants.torque_gain * v225
        if levels.inner_house:
            v262 = v202 - c17 * v91
            v263 = v203 - c17 * v94
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
            v279 = 0.5 * v198 + house.preload * z
            v280 = -0.5 * v198 + house.preload * z
        else:
            v279 = -0.5 * v91 + house.preload * z
            v280 = 0.5 * v91 + house.preload * z
            v281 = -v94
        v282 = v259 - shaft.radius * v88
        v283 = product(A, B, acc, k, later, 47, v44, v259)
        v287 = product(A, B, acc, k, later, 48, Y[k, 30], c6 * v38 + c7 * v49)
        v289 = product(A, B, acc, k, later, 50, v49, v182)
        v290 = shaft.unbalance * product(A, B, acc, k, later, 49, v38, v181) + shaft.unbalance * v289
        if contact.gap_counts_outer == 0.0:
            v294 = 0.0
        else:
            v292 = product(A, B, acc, k, later, 80, Y[k, 13], v94)
            v294 = contact.gap_counts_outer * (product(A, B, acc, k, later, 79, Y[k, 12], v91) + v292)
        v297 = product(A, B, acc, k, later, 51, v38, v170) + product(A, B, acc, k, later, 52, v49, v171)
        v298 = product(A, B, acc, k, later, 53, v200, v200)
        v299 = product(A, B, acc, k, later, 54, Y[k, 13], Y[k, 13])
        v300 = house.inner_beam_damping * v298 + house.outer_beam_damping * v299
        v302 = product(A, B, acc, k, later, 55, v71, v83 - v79)
        v303 = product(A, B, acc, k, later, 56, v75, v88)
        v305 = product(A, B, acc, k, later, 58, Y[k, 34], v282)
        v306 = -product(A, B, acc, k, later, 57, Y[k, 35], v236) + v305
        v309 = product(A, B, acc, k, later, 59, Y[k, 33], v242) - product(A, B, acc, k, later, 60, v45, v282)
        v311 = product(A, B, acc, k, later, 62, Y[k, 32], v242)
        v313 = product(A, B, acc, k, later, 63, v46, v282)
        v314 = product(A, B, acc, k, later, 61, Y[k, 34], v234) + v311 + v313
        v316 = -v91 - (v279 - v280)
        v317 = -v94 - v281
        v319 = v80 if contact.viscous_damping == 0.0 else v82
        D[k, 0] = Y[k, 7]
        D[k, 1] = Y[k, 8]
        D[k, 2] = Y[k, 9]
        D[k, 3] = Y[k, 10]
        D[k, 4] = Y[k, 11]
        D[k, 5] = Y[k, 12]
        D[k, 6] = Y[k, 13]
        D[k, 7] = v241
        D[k, 8] = v251
        D[k, 9] = v264
        D[k, 10] = v262
        D[k, 11] = v263
        D[k, 12] = v221
        D[k, 13] = v222
        D[k, 14] = v283
        D[k, 15] = shaft.arm_disk * v287
        D[k, 16] = shaft.arm_disk * v290
        D[k, 17] = v294
        D[k, 18] = 0.0
        D[k, 19] = -shaft.arm_magnet * v297
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
        D[k, 30] = pulse * Y[k, 31]
        D[k, 31] = -pulse * Y[k, 30]
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
        Y[order, i] = 0.0


@kernel
def rolling(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Rolling: 76 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east, order = memory[NORTH], memory[EAST], len(Y) - 1
    c0 = (1.0 if levels.euler else 0.0)
    c1 = contact.damping_factor / onset
    c2 = shaft.arm_magnet * shaft.arm_magnet
    c3 = 2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c4 = magnet.number * magnet.ripple * magnet.stiffness
    c5 = 0.5 * house.pair_stiffness_vertical
    c6 = 0.5 * house.pair_stiffness_horizontal
    c7 = inputs.hammer_force * inputs.hammer_x
    c8 = inputs.hammer_force * inputs.hammer_y
    c9 = shaft.arm_centre * shaft.gravity * shaft.mass
    c10 = 1.0 / shaft.transverse_inertia
    c11 = 2.0 * (1.0 if levels.euler else 0.0)
    c12 = magnet.stiffness * shaft.arm_magnet
    c13 = magnet.damping_x * shaft.arm_magnet
    c14 = magnet.damping_y * shaft.arm_magnet
    c15 = 1.0 / house.inner_mass
    c16 = 1.0 / house.outer_mass
    c17 = 1.0 / shaft.polar_inertia
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
    for k in range(order):
        if wide:
            sum_below(A, B, acc, k, 128)
        else:
            sum_below(A, B, acc, k, 76)
        v30 = product(A, B, acc, k, later, 0, Y[k, 7], Y[k, 35])
        v33 = product(A, B, acc, k, later, 1, Y[k, 7], Y[k, 33])
        D[k, 32] = v33
        D[k, 33] = -c0 * product(A, B, acc, k, later, 2, Y[k, 7], Y[k, 32])
        v38 = product(A, B, acc, k, later, 3, Y[k, 8], Y[k, 35])
        v39 = product(A, B, acc, k, later, 4, Y[k, 8], Y[k, 34])
        D[k, 34] = v38
        D[k, 35] = -c0 * v39
        v42 = product(A, B, acc, k, later, 5, Y[k, 32], Y[k, 34])
        v43 = product(A, B, acc, k, later, 6, Y[k, 7], Y[k, 34])
        v44 = Y[k, 9] + c0 * v43
        v45 = product(A, B, acc, k, later, 7, Y[k, 35], Y[k, 32])
        v46 = product(A, B, acc, k, later, 8, Y[k, 35], Y[k, 33])
        v48 = product(A, B, acc, k, later, 10, Y[k, 32], v39)
        v49 = -product(A, B, acc, k, later, 9, v30, Y[k, 33]) + c0 * v48
        v52 = shaft.arm_ring * Y[k, 34] - Y[k, 3] - contact.gap_counts_outer * Y[k, 5] - contact.offset_x * z
        v55 = -shaft.arm_ring * v45 - Y[k, 4] - contact.gap_counts_outer * Y[k, 6] - contact.offset_y * z
        v57 = shaft.arm_ring * v38 - Y[k, 10] - contact.gap_counts_outer * Y[k, 12]
        v59 = shaft.arm_ring * v49 - Y[k, 11] - contact.gap_counts_outer * Y[k, 13]
        v62 = product(A, B, acc, k, later, 11, v52, v52) + product(A, B, acc, k, later, 12, v55, v55)
        v63 = math.sqrt(v62) if k == 0 else (v62 - acc[13]) * (0.5 / A[0, 13])
        A[k, 13] = B[k, 13] = v63
        v64 = v63 - contact.clearance * z
        i66 = 1.0 / v63 if k == 0 else i66
        v66 = quotient(A, B, acc, k, later, 14, v63, v52, i66)
        i67 = 1.0 / v63 if k == 0 else i67
        v67 = quotient(A, B, acc, k, later, 15, v63, v55, i67)
        v70 = product(A, B, acc, k, later, 16, v57, v66) + product(A, B, acc, k, later, 17, v59, v67)
        v73 = product(A, B, acc, k, later, 18, v59, v66) - product(A, B, acc, k, later, 19, v57, v67)
        v74 = v73 + shaft.radius * v44
        if contact.exponent == 1.5:
            v75 = math.sqrt(v64) if k == 0 else (v64 - acc[20]) * (0.5 / A[0, 20])
            A[k, 20] = B[k, 20] = v75
            v79 = contact.stiffness * product(A, B, acc, k, later, 21, v64, v75)
        elif contact.exponent == 1.0:
            v79 = contact.stiffness * v64
        else:
            v77 = v64 ** contact.exponent if k == 0 else (contact.exponent * (acc[76] + k * v64 * B[0, 76]) - acc[77]) / (k * B[0, 77])
            A[k, 76], B[k, 76], A[k, 77], B[k, 77] = k * v64, v77, k * v77, v64
            v79 = contact.stiffness * v77
        v82 = product(A, B, acc, k, later, 22, v79, c1 * v70 + z) + contact.viscous_damping * v70
        v83 = 0.0 if slack else v82
        v84 = product(A, B, acc, k, later, 23, v66, v83)
        v85 = product(A, B, acc, k, later, 24, v67, v83)
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v158 = -c12 * Y[k, 34]
                v159 = c12 * v45
            elif magnet.terms == RADIAL:
                v107 = product(A, B, acc, k, later, 26, v45, v45)
                v108 = c2 * product(A, B, acc, k, later, 25, Y[k, 34], Y[k, 34]) + c2 * v107
                v111 = product(A, B, acc, k, later, 27, v108, magnet.a7 * v108 + magnet.a5 * z) + magnet.a3 * z
                v113 = product(A, B, acc, k, later, 28, v108, v111) + z
                v158 = -c12 * product(A, B, acc, k, later, 29, Y[k, 34], v113)
                v159 = c12 * product(A, B, acc, k, later, 30, v45, v113)
            else:
                v123 = product(A, B, acc, k, later, 79, v45, v45)
                v124 = c2 * product(A, B, acc, k, later, 78, Y[k, 34], Y[k, 34]) + c2 * v123
                v127 = product(A, B, acc, k, later, 80, v124, magnet.a7 * v124 + magnet.a5 * z) + magnet.a3 * z
                power_x, power_y = complex_power(
                    A, B, acc, k, later, 90, shaft.arm_magnet * v45, shaft.arm_magnet * Y[k, 34], int((magnet.number + -1.0))
                )
                v137 = power_x
                v138 = power_y
                v140 = product(A, B, acc, k, later, 83, Y[k, 34], v138)
                v141 = shaft.arm_magnet * product(A, B, acc, k, later, 82, v45, v137) - shaft.arm_magnet * v140
                v142 = magnet.growth * v124 + z
                v143 = -magnet.stiffness * (product(A, B, acc, k, later, 81, v124, v127) + z) - c3 * v141
                v145 = product(A, B, acc, k, later, 85, v138, v142)
                v158 = shaft.arm_magnet * product(A, B, acc, k, later, 84, Y[k, 34], v143) + c4 * v145
                v148 = product(A, B, acc, k, later, 87, v137, v142)
                v159 = -shaft.arm_magnet * product(A, B, acc, k, later, 86, v45, v143) + c4 * v148
            v161 = -c13 * v38
            v162 = -c14 * v49
        else:
            v158 = 0.0
            v159 = 0.0
            v161 = 0.0
            v162 = 0.0
        v168 = product(A, B, acc, k, later, 31, Y[k, 9], Y[k, 37])
        v169 = product(A, B, acc, k, later, 32, Y[k, 9], Y[k, 36])
        D[k, 36] = v168
        D[k, 37] = -v169
        v172 = product(A, B, acc, k, later, 33, Y[k, 9], v168)
        v173 = product(A, B, acc, k, later, 34, Y[k, 9], v169)
        if levels.inner_house:
            v174 = Y[k, 4] - Y[k, 6]
            v187 = 0.0 if north < 0.0 else c5 * v174 + house.preload * z
            v188 = 0.0 if north > 0.0 else -c5 * v174 + house.preload * z
            v191 = Y[k, 10] - Y[k, 12]
            v189 = house.inner_beam_stiffness * (Y[k, 3] - Y[k, 5]) + house.inner_beam_damping * v191
            v193 = -c15 * v189
            v194 = -c15 * (v187 - v188)
        else:
            v187 = house.preload * z
            v188 = house.preload * z
            v189 = 0.0
            v191 = 0.0
            v193 = 0.0
            v194 = 0.0
        if levels.outer_house:
            v208 = 0.0 if east < 0.0 else c6 * Y[k, 5] + house.preload * z
            v209 = 0.0 if east > 0.0 else -c6 * Y[k, 5] + house.preload * z
            v210 = house.outer_beam_stiffness * Y[k, 6] + house.outer_beam_damping * Y[k, 13]
            v212 = c16 * (v189 - (v208 - v209))
            v213 = c16 * (v187 - v188 - v210)
        else:
            v208 = house.preload * z
            v209 = house.preload * z
            v210 = 0.0
            v212 = 0.0
            v213 = 0.0
        v216 = inputs.speed_slope * Y[k, 29] + aim * z - Y[k, 9]
        v219 = shaft.arm_magnet * (v158 + v161) + shaft.arm_disk * (shaft.unbalance * v172 + c7 * Y[k, 30])
        v222 = shaft.arm_magnet * (v159 + v162) + shaft.arm_disk * (shaft.unbalance * v173 + c8 * Y[k, 30])
        v223 = v222 - c9 * z
        v228 = product(A, B, acc, k, later, 35, Y[k, 8], v44)
        v230 = product(A, B, acc, k, later, 36, Y[k, 8], v43)
        v237 = product(A, B, acc, k, later, 37, v30, v44)
        v241 = product(A, B, acc, k, later, 39, v30, v43)
        v244 = product(A, B, acc, k, later, 40, Y[k, 8], v30)
        v254 = 0.0
        v256 = -v84 + product(A, B, acc, k, later, 41, v67, v254)
        v258 = -v85 - product(A, B, acc, k, later, 42, v66, v254)
        v260 = v223 + shaft.arm_ring * v258
        v261 = product(A, B, acc, k, later, 43, Y[k, 33], v260)
        i264 = 1.0 / Y[k, 35] if k == 0 else i264
        v264 = quotient(A, B, acc, k, later, 44, Y[k, 35], c10 * (-v261 - shaft.polar_inertia * v228) + c11 * v230, i264)
        v265 = product(A, B, acc, k, later, 45, Y[k, 35], v219 + shaft.arm_ring * v256)
        v268 = v265 + c0 * product(A, B, acc, k, later, 46, v42, v260) + shaft.polar_inertia * v237
        v269 = c10 * v268 - c0 * v241
        v271 = c0 * product(A, B, acc, k, later, 47, Y[k, 34], v264) + c0 * v244
        if inputs.ideal_drive:
            v275 = v271 + inputs.speed_slope * z
        else:
            v275 = c17 * (constants.torque_gain * v216 - shaft.radius * v254)
        if levels.inner_house:
            v279 = v193 - c15 * v256
            v280 = v194 - c15 * v258
        else:
            v279 = v193
            v280 = v194
        if levels.outer_house:
            pass
        elif levels.inner_house:
            v282 = v187 - v188
            v283 = 0.5 * v189 + house.preload * z
            v284 = -0.5 * v189 + house.preload * z
        v304 = product(A, B, acc, k, later, 49, Y[k, 30], c7 * v38 + c8 * v49)
        v306 = product(A, B, acc, k, later, 51, v49, v173)
        v307 = shaft.unbalance * product(A, B, acc, k, later, 50, v38, v172) + shaft.unbalance * v306
        v314 = product(A, B, acc, k, later, 52, v38, v161) + product(A, B, acc, k, later, 53, v49, v162)
        v315 = product(A, B, acc, k, later, 54, v191, v191)
        v316 = product(A, B, acc, k, later, 55, Y[k, 13], Y[k, 13])
        v317 = house.inner_beam_damping * v315 + house.outer_beam_damping * v316
        v319 = product(A, B, acc, k, later, 56, v70, v83 - v79)
        v335 = product(A, B, acc, k, later, 65, Y[k, 8], Y[k, 8])
        v336 = product(A, B, acc, k, later, 38, Y[k, 7], Y[k, 7]) + v335
        v338 = product(A, B, acc, k, later, 67, Y[k, 34], v335)
        v342 = -product(A, B, acc, k, later, 68, v46, v264) + c0 * product(A, B, acc, k, later, 69, v42, v269)
        v343 = product(A, B, acc, k, later, 70, v45, v336)
        v346 = product(A, B, acc, k, later, 71, v33, v39)
        v355 = shaft.arm_ring * (product(A, B, acc, k, later, 66, Y[k, 35], v269) - c0 * v338) - v279
        v358 = shaft.arm_ring * (v342 + c0 * v343 + c11 * v346) - v280 - contact.gap_counts_outer * v213
        v360 = product(A, B, acc, k, later, 73, v67, v355 - contact.gap_counts_outer * v212)
        v362 = product(A, B, acc, k, later, 74, v70, v73)
        i363 = 1.0 / v63 if k == 0 else i363
        v363 = quotient(A, B, acc, k, later, 75, v63, v362, i363)
        v365 = product(A, B, acc, k, later, 72, v66, v358) - v360 - v363 + shaft.radius * v275
        friction = v365 * per_friction
        v254 = friction
        v256 = -v84 + product(A, B, acc, k, later, 41, v67, v254)
        v258 = -v85 - product(A, B, acc, k, later, 42, v66, v254)
        v260 = v223 + shaft.arm_ring * v258
        v261 = product(A, B, acc, k, later, 43, Y[k, 33], v260)
        i264 = 1.0 / Y[k, 35] if k == 0 else i264
        v264 = quotient(A, B, acc, k, later, 44, Y[k, 35], c10 * (-v261 - shaft.polar_inertia * v228) + c11 * v230, i264)
        v265 = product(A, B, acc, k, later, 45, Y[k, 35], v219 + shaft.arm_ring * v256)
        v268 = v265 + c0 * product(A, B, acc, k, later, 46, v42, v260) + shaft.polar_inertia * v237
        v269 = c10 * v268 - c0 * v241
        v271 = c0 * product(A, B, acc, k, later, 47, Y[k, 34], v264) + c0 * v244
        if inputs.ideal_drive:
            v275 = v271 + inputs.speed_slope * z
            v276 = shaft.polar_inertia * v275 + shaft.radius * v254
        else:
            v275 = c17 * (constants.torque_gain * v216 - shaft.radius * v254)
            v276 = constants.torque_gain * v216
        if levels.inner_house:
            v279 = v193 - c15 * v256
            v280 = v194 - c15 * v258
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
            v296 = -0.5 * v256 + house.preload * z
            v297 = 0.5 * v256 + house.preload * z
            v298 = -v258
        v299 = v276 - shaft.radius * v254
        v300 = product(A, B, acc, k, later, 48, v44, v276)
        if contact.gap_counts_outer == 0.0:
            v311 = 0.0
        else:
            v309 = product(A, B, acc, k, later, 89, Y[k, 13], v258)
            v311 = contact.gap_counts_outer * (product(A, B, acc, k, later, 88, Y[k, 12], v256) + v309)
        v320 = product(A, B, acc, k, later, 57, v74, v254)
        v322 = product(A, B, acc, k, later, 59, Y[k, 34], v299)
        v323 = -product(A, B, acc, k, later, 58, Y[k, 35], v261) + v322
        v326 = product(A, B, acc, k, later, 60, Y[k, 33], v265) - product(A, B, acc, k, later, 61, v45, v299)
        v328 = product(A, B, acc, k, later, 63, Y[k, 32], v265)
        v330 = product(A, B, acc, k, later, 64, v46, v299)
        v331 = product(A, B, acc, k, later, 62, Y[k, 34], v260) + v328 + v330
        v333 = -v256 - (v296 - v297)
        v334 = -v258 - v298
        v342 = -product(A, B, acc, k, later, 68, v46, v264) + c0 * product(A, B, acc, k, later, 69, v42, v269)
        v355 = shaft.arm_ring * (product(A, B, acc, k, later, 66, Y[k, 35], v269) - c0 * v338) - v279
        v358 = shaft.arm_ring * (v342 + c0 * v343 + c11 * v346) - v280 - contact.gap_counts_outer * v213
        v360 = product(A, B, acc, k, later, 73, v67, v355 - contact.gap_counts_outer * v212)
        v365 = product(A, B, acc, k, later, 72, v66, v358) - v360 - v363 + shaft.radius * v275
        D[k, 0] = Y[k, 7]
        D[k, 1] = Y[k, 8]
        D[k, 2] = Y[k, 9]
        D[k, 3] = Y[k, 10]
        D[k, 4] = Y[k, 11]
        D[k, 5] = Y[k, 12]
        D[k, 6] = Y[k, 13]
        D[k, 7] = v264
        D[k, 8] = v269
        D[k, 9] = v281
        D[k, 10] = v279
        D[k, 11] = v280
        D[k, 12] = v212
        D[k, 13] = v213
        D[k, 14] = v300
        D[k, 15] = shaft.arm_disk * v304
        D[k, 16] = shaft.arm_disk * v307
        D[k, 17] = v311
        D[k, 18] = 0.0
        D[k, 19] = -shaft.arm_magnet * v314
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
        D[k, 30] = pulse * Y[k, 31]
        D[k, 31] = -pulse * Y[k, 30]
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
        Y[order, i] = 0.0
