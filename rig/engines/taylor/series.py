"""Coefficients of the Taylor series, by phase.

Made by `NUMBA_DISABLE_JIT=1 python -m rig.engines.tape.taylor`: do not edit; tests/physics/test_taylor.py compares it.
"""

# pyright: reportPossiblyUnboundVariable=false

from __future__ import annotations

import math

from rig.engines.memory import ONSET, PHASE
from rig.engines.taylor.place import EAST, NORTH, ORDER, SLACK
from rig.kernels.contact import BACKWARD, EXACT, FLIGHT, FORWARD, NO_FRICTION, ROLLING, SMOOTHED, TOUCHING  # noqa: F401
from rig.kernels.geometry import sines_of
from rig.kernels.magnet import LINEAR, RADIAL, RIPPLED  # noqa: F401
from rig.kernels.stage import kernel, stage


@stage
def product(below, left_0, right_0, later, left, right):
    """The k-th coefficient of a product; `later` is 0 for k = 0, else 1. No array goes in: that counts references."""
    return below + left_0 * right + left * (later * right_0)


@stage
def quotient(below, first, divisor, dividend, inverse):
    """The k-th coefficient of a quotient that begins with `first` (for k = 0: 0), by the inverse of the divisor's."""
    return (dividend - below - divisor * first) * inverse


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
    c7 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c8 = magnet.stiffness * shaft.arm_magnet
    c9 = shaft.arm_magnet * shaft.arm_magnet
    c10 = magnet.a7
    c11 = magnet.a5
    c12 = magnet.a3
    c13 = shaft.arm_magnet
    c14 = -1.0 * shaft.arm_magnet
    c15 = magnet.growth
    c16 = -1.0 * magnet.stiffness
    c17 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c18 = magnet.number * magnet.ripple * magnet.stiffness
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
    c35 = inputs.hammer_force * inputs.hammer_x
    c36 = shaft.arm_disk
    c37 = inputs.hammer_force * inputs.hammer_y
    c38 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c39 = -1.0 * shaft.polar_inertia
    c40 = 1.0 / shaft.transverse_inertia
    c41 = 2.0 * (1.0 if levels.euler else 0.0)
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
    wide = (
        contact.gap_counts_outer != 0.0
        or (contact.exponent != 1.5 and contact.exponent != 1.0)
        or levels.friction == SMOOTHED
        or (inputs.magnet_engaged and magnet.terms == RIPPLED)
    )
    for p in range(96):
        A[0, p] = B[0, p] = 0.0
    z, later = 1.0, 0.0
    for k in range(ORDER):
        for p in range(96):
            acc[p] = 0.0
        if wide:
            for j in range(1, k):
                for p in range(96):
                    acc[p] += A[j, p] * B[k - j, p]
        else:
            for j in range(1, k):
                for p in range(48):
                    acc[p] += A[j, p] * B[k - j, p]
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
        A[k, 0], B[k, 0] = v7, v29
        v30 = product(acc[0], A[0, 0], B[0, 0], later, v7, v29)
        v31 = Y[k, 32]
        v32 = Y[k, 33]
        A[k, 1], B[k, 1] = v7, v32
        v33 = product(acc[1], A[0, 1], B[0, 1], later, v7, v32)
        A[k, 2], B[k, 2] = v7, v31
        v34 = product(acc[2], A[0, 2], B[0, 2], later, v7, v31)
        D[k, 32] = v33
        D[k, 33] = c0 * v34
        v37 = Y[k, 34]
        A[k, 3], B[k, 3] = v8, v29
        v38 = product(acc[3], A[0, 3], B[0, 3], later, v8, v29)
        A[k, 4], B[k, 4] = v8, v37
        v39 = product(acc[4], A[0, 4], B[0, 4], later, v8, v37)
        D[k, 34] = v38
        D[k, 35] = c0 * v39
        A[k, 5], B[k, 5] = v31, v37
        v42 = product(acc[5], A[0, 5], B[0, 5], later, v31, v37)
        A[k, 6], B[k, 6] = v7, v37
        v43 = product(acc[6], A[0, 6], B[0, 6], later, v7, v37)
        v44 = v9 + c1 * v43
        A[k, 7], B[k, 7] = v29, v31
        v45 = product(acc[7], A[0, 7], B[0, 7], later, v29, v31)
        A[k, 8], B[k, 8] = v29, v32
        v46 = product(acc[8], A[0, 8], B[0, 8], later, v29, v32)
        A[k, 9], B[k, 9] = v30, v32
        v47 = product(acc[9], A[0, 9], B[0, 9], later, v30, v32)
        A[k, 10], B[k, 10] = v31, v39
        v48 = product(acc[10], A[0, 10], B[0, 10], later, v31, v39)
        v49 = -v47 + c1 * v48
        v50 = c2 * v37 - v3
        v51 = v50 + c3 * v5
        v52 = v51 + c4 * z
        v53 = c5 * v45 - v4
        v54 = v53 + c3 * v6
        v55 = v54 + c6 * z
        A[k, 11], B[k, 11] = v52, v52
        v60 = product(acc[11], A[0, 11], B[0, 11], later, v52, v52)
        A[k, 12], B[k, 12] = v55, v55
        v61 = product(acc[12], A[0, 12], B[0, 12], later, v55, v55)
        v62 = v60 + v61
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v144 = c7 * v37
                v145 = c8 * v45
            else:
                if magnet.terms == RADIAL:
                    A[k, 13], B[k, 13] = v37, v37
                    v95 = product(acc[13], A[0, 13], B[0, 13], later, v37, v37)
                    A[k, 14], B[k, 14] = v45, v45
                    v96 = product(acc[14], A[0, 14], B[0, 14], later, v45, v45)
                    v97 = c9 * v95 + c9 * v96
                    v98 = c10 * v97 + c11 * z
                    A[k, 15], B[k, 15] = v97, v98
                    v99 = product(acc[15], A[0, 15], B[0, 15], later, v97, v98)
                    v100 = v99 + c12 * z
                    A[k, 16], B[k, 16] = v97, v100
                    v101 = product(acc[16], A[0, 16], B[0, 16], later, v97, v100)
                    v102 = v101 + z
                    A[k, 17], B[k, 17] = v37, v102
                    v109 = product(acc[17], A[0, 17], B[0, 17], later, v37, v102)
                    A[k, 18], B[k, 18] = v45, v102
                    v110 = product(acc[18], A[0, 18], B[0, 18], later, v45, v102)
                    v141 = c7 * v109
                    v142 = c8 * v110
                else:
                    A[k, 48], B[k, 48] = v37, v37
                    v111 = product(acc[48], A[0, 48], B[0, 48], later, v37, v37)
                    A[k, 49], B[k, 49] = v45, v45
                    v112 = product(acc[49], A[0, 49], B[0, 49], later, v45, v45)
                    v113 = c9 * v111 + c9 * v112
                    v114 = c10 * v113 + c11 * z
                    A[k, 50], B[k, 50] = v113, v114
                    v115 = product(acc[50], A[0, 50], B[0, 50], later, v113, v114)
                    v116 = v115 + c12 * z
                    A[k, 51], B[k, 51] = v113, v116
                    v117 = product(acc[51], A[0, 51], B[0, 51], later, v113, v116)
                    v118 = v117 + z
                    square_x, square_y = c13 * v45, c13 * v37
                    wave_x, wave_y = z, 0.0
                    bits, lane, begun = int((magnet.number + -1.0)), 58, False
                    while bits > 0:
                        if bits & 1:
                            if begun:
                                A[k, lane], B[k, lane], A[k, lane + 1], B[k, lane + 1] = wave_x, square_x, wave_y, square_y
                                A[k, lane + 2], B[k, lane + 2], A[k, lane + 3], B[k, lane + 3] = wave_x, square_y, wave_y, square_x
                                one = product(acc[lane], A[0, lane], B[0, lane], later, wave_x, square_x)
                                one -= product(acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, wave_y, square_y)
                                two = product(acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, wave_x, square_y)
                                two += product(acc[lane + 3], A[0, lane + 3], B[0, lane + 3], later, wave_y, square_x)
                                wave_x, wave_y = one, two
                                lane += 4
                            else:
                                wave_x, wave_y, begun = square_x, square_y, True
                        bits >>= 1
                        if bits > 0:
                            A[k, lane], B[k, lane], A[k, lane + 1], B[k, lane + 1] = square_x, square_x, square_y, square_y
                            A[k, lane + 2], B[k, lane + 2] = square_x, square_y
                            one = product(acc[lane], A[0, lane], B[0, lane], later, square_x, square_x)
                            one -= product(acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, square_y, square_y)
                            square_y = 2.0 * product(acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, square_x, square_y)
                            square_x = one
                            lane += 3
                    v126 = wave_x
                    v127 = wave_y
                    A[k, 52], B[k, 52] = v45, v126
                    v128 = product(acc[52], A[0, 52], B[0, 52], later, v45, v126)
                    A[k, 53], B[k, 53] = v37, v127
                    v129 = product(acc[53], A[0, 53], B[0, 53], later, v37, v127)
                    v130 = c13 * v128 + c14 * v129
                    v131 = c15 * v113 + z
                    v132 = c16 * v118 + c17 * v130
                    A[k, 54], B[k, 54] = v37, v132
                    v133 = product(acc[54], A[0, 54], B[0, 54], later, v37, v132)
                    A[k, 55], B[k, 55] = v127, v131
                    v134 = product(acc[55], A[0, 55], B[0, 55], later, v127, v131)
                    v135 = c13 * v133 + c18 * v134
                    A[k, 56], B[k, 56] = v45, v132
                    v136 = product(acc[56], A[0, 56], B[0, 56], later, v45, v132)
                    A[k, 57], B[k, 57] = v126, v131
                    v137 = product(acc[57], A[0, 57], B[0, 57], later, v126, v131)
                    v138 = c14 * v136 + c18 * v137
                    v141 = v135
                    v142 = v138
                v144 = v141
                v145 = v142
            v147 = v144
            v148 = v145
            v150 = c19 * v38
            v151 = c20 * v49
        else:
            v147 = 0.0
            v148 = 0.0
            v150 = 0.0
            v151 = 0.0
        v154 = Y[k, 30]
        v155 = Y[k, 36]
        v156 = Y[k, 37]
        A[k, 19], B[k, 19] = v9, v156
        v157 = product(acc[19], A[0, 19], B[0, 19], later, v9, v156)
        A[k, 20], B[k, 20] = v9, v155
        v158 = product(acc[20], A[0, 20], B[0, 20], later, v9, v155)
        D[k, 36] = v157
        D[k, 37] = -v158
        A[k, 21], B[k, 21] = v9, v157
        v161 = product(acc[21], A[0, 21], B[0, 21], later, v9, v157)
        A[k, 22], B[k, 22] = v9, v158
        v162 = product(acc[22], A[0, 22], B[0, 22], later, v9, v158)
        if levels.inner_house:
            v163 = v4 - v6
            v164 = c21 * v163 + c22 * z
            if north < 0.0:
                v165 = 0.0
            else:
                v165 = v164
            v166 = c23 * v163 + c22 * z
            if north > 0.0:
                v167 = 0.0
            else:
                v167 = v166
            v172 = v3 - v5
            v173 = v10 - v12
            v174 = c24 * v172 + c25 * v173
            v175 = v165 - v167
            v176 = v165
            v177 = v167
            v178 = v174
            v180 = v173
            v182 = c26 * v174
            v183 = c26 * v175
        else:
            v176 = c22 * z
            v177 = c22 * z
            v178 = 0.0
            v180 = 0.0
            v182 = 0.0
            v183 = 0.0
        if levels.outer_house:
            v184 = c27 * v5 + c22 * z
            if east < 0.0:
                v185 = 0.0
            else:
                v185 = v184
            v186 = c28 * v5 + c22 * z
            if east > 0.0:
                v187 = 0.0
            else:
                v187 = v186
            v192 = c29 * v6 + c30 * v13
            v193 = v185 - v187
            v194 = v178 - v193
            v195 = v176 - v177
            v196 = v195 - v192
            v197 = v185
            v198 = v187
            v199 = v192
            v201 = c31 * v194
            v202 = c31 * v196
        else:
            v197 = c22 * z
            v198 = c22 * z
            v199 = 0.0
            v201 = 0.0
            v202 = 0.0
        v203 = Y[k, 29]
        v204 = c32 * v203 + c33 * z
        v205 = v204 - v9
        v206 = v147 + v150
        v207 = c34 * v161 + c35 * v154
        v208 = c13 * v206 + c36 * v207
        v209 = v148 + v151
        v210 = c34 * v162 + c37 * v154
        v211 = c13 * v209 + c36 * v210
        v212 = v211 + c38 * z
        A[k, 23], B[k, 23] = v32, v212
        v214 = product(acc[23], A[0, 23], B[0, 23], later, v32, v212)
        A[k, 24], B[k, 24] = v8, v44
        v215 = product(acc[24], A[0, 24], B[0, 24], later, v8, v44)
        v216 = -v214 + c39 * v215
        A[k, 25], B[k, 25] = v8, v43
        v217 = product(acc[25], A[0, 25], B[0, 25], later, v8, v43)
        v218 = c40 * v216 + c41 * v217
        i219 = 1.0 / v29 if k == 0 else i219
        v219 = quotient(acc[26], later * B[0, 26], v29, v218, i219)
        A[k, 26], B[k, 26] = v29, v219
        A[k, 27], B[k, 27] = v29, v208
        v220 = product(acc[27], A[0, 27], B[0, 27], later, v29, v208)
        A[k, 28], B[k, 28] = v42, v212
        v221 = product(acc[28], A[0, 28], B[0, 28], later, v42, v212)
        v222 = v220 + c1 * v221
        A[k, 29], B[k, 29] = v30, v44
        v224 = product(acc[29], A[0, 29], B[0, 29], later, v30, v44)
        v225 = v222 + c42 * v224
        A[k, 30], B[k, 30] = v30, v43
        v228 = product(acc[30], A[0, 30], B[0, 30], later, v30, v43)
        v229 = c40 * v225 + c0 * v228
        A[k, 31], B[k, 31] = v37, v219
        v230 = product(acc[31], A[0, 31], B[0, 31], later, v37, v219)
        A[k, 32], B[k, 32] = v8, v30
        v231 = product(acc[32], A[0, 32], B[0, 32], later, v8, v30)
        v232 = c1 * v230 + c1 * v231
        if inputs.ideal_drive:
            v233 = v232 + c32 * z
            v234 = v233
            v235 = c42 * v233
        else:
            v234 = c43 * v205
            v235 = c44 * v205
        v236 = v234 - v232
        if levels.outer_house:
            v247 = v197
            v248 = v198
            v249 = v199
        else:
            if levels.inner_house:
                v237 = v176 - v177
                v238 = 0.5 * v178 + c22 * z
                v239 = -0.5 * v178 + c22 * z
                v242 = v238
                v243 = v239
                v244 = v237
            else:
                v242 = c22 * z
                v243 = c22 * z
                v244 = 0.0
            v247 = v242
            v248 = v243
            v249 = v244
        A[k, 33], B[k, 33] = v44, v235
        v250 = product(acc[33], A[0, 33], B[0, 33], later, v44, v235)
        v253 = c35 * v38 + c37 * v49
        A[k, 34], B[k, 34] = v154, v253
        v254 = product(acc[34], A[0, 34], B[0, 34], later, v154, v253)
        A[k, 35], B[k, 35] = v38, v161
        v255 = product(acc[35], A[0, 35], B[0, 35], later, v38, v161)
        A[k, 36], B[k, 36] = v49, v162
        v256 = product(acc[36], A[0, 36], B[0, 36], later, v49, v162)
        v257 = c34 * v255 + c34 * v256
        A[k, 37], B[k, 37] = v38, v150
        v258 = product(acc[37], A[0, 37], B[0, 37], later, v38, v150)
        A[k, 38], B[k, 38] = v49, v151
        v259 = product(acc[38], A[0, 38], B[0, 38], later, v49, v151)
        v260 = v258 + v259
        A[k, 39], B[k, 39] = v180, v180
        v261 = product(acc[39], A[0, 39], B[0, 39], later, v180, v180)
        A[k, 40], B[k, 40] = v13, v13
        v262 = product(acc[40], A[0, 40], B[0, 40], later, v13, v13)
        v263 = c25 * v261 + c30 * v262
        A[k, 41], B[k, 41] = v29, v214
        v264 = product(acc[41], A[0, 41], B[0, 41], later, v29, v214)
        A[k, 42], B[k, 42] = v37, v235
        v265 = product(acc[42], A[0, 42], B[0, 42], later, v37, v235)
        v266 = -v264 + v265
        A[k, 43], B[k, 43] = v32, v220
        v267 = product(acc[43], A[0, 43], B[0, 43], later, v32, v220)
        A[k, 44], B[k, 44] = v45, v235
        v268 = product(acc[44], A[0, 44], B[0, 44], later, v45, v235)
        v269 = v267 - v268
        A[k, 45], B[k, 45] = v37, v212
        v270 = product(acc[45], A[0, 45], B[0, 45], later, v37, v212)
        A[k, 46], B[k, 46] = v31, v220
        v271 = product(acc[46], A[0, 46], B[0, 46], later, v31, v220)
        v272 = v270 + v271
        A[k, 47], B[k, 47] = v46, v235
        v273 = product(acc[47], A[0, 47], B[0, 47], later, v46, v235)
        v274 = v272 + v273
        v275 = v247 - v248
        v276 = Y[k, 31]
        D[k, 0] = v7
        D[k, 1] = v8
        D[k, 2] = v9
        D[k, 3] = v10
        D[k, 4] = v11
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
    c8 = contact.stiffness
    c9 = 2.0 * contact.exponent
    c10 = contact.damping_factor / onset
    c11 = contact.viscous_damping
    c12 = contact.friction
    c13 = -1.0 * contact.friction
    c14 = 1.0 / contact.smoothing_speed
    c15 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c16 = magnet.stiffness * shaft.arm_magnet
    c17 = shaft.arm_magnet * shaft.arm_magnet
    c18 = magnet.a7
    c19 = magnet.a5
    c20 = magnet.a3
    c21 = shaft.arm_magnet
    c22 = -1.0 * shaft.arm_magnet
    c23 = magnet.growth
    c24 = -1.0 * magnet.stiffness
    c25 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c26 = magnet.number * magnet.ripple * magnet.stiffness
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
    c43 = inputs.hammer_force * inputs.hammer_x
    c44 = shaft.arm_disk
    c45 = inputs.hammer_force * inputs.hammer_y
    c46 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c47 = -1.0 * shaft.polar_inertia
    c48 = 1.0 / shaft.transverse_inertia
    c49 = 2.0 * (1.0 if levels.euler else 0.0)
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
    wide = (
        contact.gap_counts_outer != 0.0
        or (contact.exponent != 1.5 and contact.exponent != 1.0)
        or levels.friction == SMOOTHED
        or (inputs.magnet_engaged and magnet.terms == RIPPLED)
    )
    for p in range(120):
        A[0, p] = B[0, p] = 0.0
    z, later = 1.0, 0.0
    for k in range(ORDER):
        for p in range(120):
            acc[p] = 0.0
        if wide:
            for j in range(1, k):
                for p in range(120):
                    acc[p] += A[j, p] * B[k - j, p]
        else:
            for j in range(1, k):
                for p in range(64):
                    acc[p] += A[j, p] * B[k - j, p]
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
        A[k, 0], B[k, 0] = v7, v29
        v30 = product(acc[0], A[0, 0], B[0, 0], later, v7, v29)
        v31 = Y[k, 32]
        v32 = Y[k, 33]
        A[k, 1], B[k, 1] = v7, v32
        v33 = product(acc[1], A[0, 1], B[0, 1], later, v7, v32)
        A[k, 2], B[k, 2] = v7, v31
        v34 = product(acc[2], A[0, 2], B[0, 2], later, v7, v31)
        D[k, 32] = v33
        D[k, 33] = c0 * v34
        v37 = Y[k, 34]
        A[k, 3], B[k, 3] = v8, v29
        v38 = product(acc[3], A[0, 3], B[0, 3], later, v8, v29)
        A[k, 4], B[k, 4] = v8, v37
        v39 = product(acc[4], A[0, 4], B[0, 4], later, v8, v37)
        D[k, 34] = v38
        D[k, 35] = c0 * v39
        A[k, 5], B[k, 5] = v31, v37
        v42 = product(acc[5], A[0, 5], B[0, 5], later, v31, v37)
        A[k, 6], B[k, 6] = v7, v37
        v43 = product(acc[6], A[0, 6], B[0, 6], later, v7, v37)
        v44 = v9 + c1 * v43
        A[k, 7], B[k, 7] = v29, v31
        v45 = product(acc[7], A[0, 7], B[0, 7], later, v29, v31)
        A[k, 8], B[k, 8] = v29, v32
        v46 = product(acc[8], A[0, 8], B[0, 8], later, v29, v32)
        A[k, 9], B[k, 9] = v30, v32
        v47 = product(acc[9], A[0, 9], B[0, 9], later, v30, v32)
        A[k, 10], B[k, 10] = v31, v39
        v48 = product(acc[10], A[0, 10], B[0, 10], later, v31, v39)
        v49 = -v47 + c1 * v48
        v50 = c2 * v37 - v3
        v51 = v50 + c3 * v5
        v52 = v51 + c4 * z
        v53 = c5 * v45 - v4
        v54 = v53 + c3 * v6
        v55 = v54 + c6 * z
        v56 = c2 * v38 - v10
        v57 = v56 + c3 * v12
        v58 = c2 * v49 - v11
        v59 = v58 + c3 * v13
        A[k, 11], B[k, 11] = v52, v52
        v60 = product(acc[11], A[0, 11], B[0, 11], later, v52, v52)
        A[k, 12], B[k, 12] = v55, v55
        v61 = product(acc[12], A[0, 12], B[0, 12], later, v55, v55)
        v62 = v60 + v61
        v63 = math.sqrt(v62) if k == 0 else (v62 - acc[13]) * (0.5 / A[0, 13])
        A[k, 13] = B[k, 13] = v63
        v64 = Y[k, 38]
        A[k, 14], B[k, 14] = v64, v64
        v65 = product(acc[14], A[0, 14], B[0, 14], later, v64, v64)
        i67 = 1.0 / v63 if k == 0 else i67
        v67 = quotient(acc[15], later * B[0, 15], v63, v52, i67)
        A[k, 15], B[k, 15] = v63, v67
        i68 = 1.0 / v63 if k == 0 else i68
        v68 = quotient(acc[16], later * B[0, 16], v63, v55, i68)
        A[k, 16], B[k, 16] = v63, v68
        A[k, 17], B[k, 17] = v57, v67
        v69 = product(acc[17], A[0, 17], B[0, 17], later, v57, v67)
        A[k, 18], B[k, 18] = v59, v68
        v70 = product(acc[18], A[0, 18], B[0, 18], later, v59, v68)
        v71 = v69 + v70
        A[k, 19], B[k, 19] = v59, v67
        v72 = product(acc[19], A[0, 19], B[0, 19], later, v59, v67)
        A[k, 20], B[k, 20] = v57, v68
        v73 = product(acc[20], A[0, 20], B[0, 20], later, v57, v68)
        v74 = v72 - v73
        v75 = v74 + c7 * v44
        if contact.exponent == 1.5:
            A[k, 21], B[k, 21] = v64, v65
            v76 = product(acc[21], A[0, 21], B[0, 21], later, v64, v65)
            v79 = c8 * v76
        else:
            if contact.exponent == 1.0:
                v78 = c8 * v65
            else:
                v77 = v64 ** c9 if k == 0 else (c9 * (acc[64] + k * v64 * B[0, 64]) - acc[65]) / (k * B[0, 65])
                A[k, 64], B[k, 64], A[k, 65], B[k, 65] = k * v64, v77, k * v77, v64
                v78 = c8 * v77
            v79 = v78
        v80 = c10 * v71 + z
        A[k, 22], B[k, 22] = v79, v80
        v81 = product(acc[22], A[0, 22], B[0, 22], later, v79, v80)
        v82 = v81 + c11 * v71
        if slack:
            v83 = 0.0
        else:
            v83 = v82
        if phase == FORWARD:
            v88 = c12 * v83
        else:
            if phase == BACKWARD:
                v87 = c13 * v83
            else:
                if levels.friction == SMOOTHED:
                    v84 = math.tanh(c14 * v75) if k == 0 else (acc[66] + k * (c14 * v75) * B[0, 66]) / k
                    A[k, 66] = k * (c14 * v75)
                    A[k, 67], B[k, 67] = v84, v84
                    B[k, 66] = z - product(acc[67], A[0, 67], B[0, 67], later, v84, v84)
                    A[k, 68], B[k, 68] = v83, v84
                    v85 = product(acc[68], A[0, 68], B[0, 68], later, v83, v84)
                    v86 = c12 * v85
                else:
                    v86 = 0.0
                v87 = v86
            v88 = v87
        A[k, 23], B[k, 23] = v67, v83
        v89 = product(acc[23], A[0, 23], B[0, 23], later, v67, v83)
        A[k, 24], B[k, 24] = v68, v88
        v90 = product(acc[24], A[0, 24], B[0, 24], later, v68, v88)
        v91 = -v89 + v90
        A[k, 25], B[k, 25] = v68, v83
        v92 = product(acc[25], A[0, 25], B[0, 25], later, v68, v83)
        A[k, 26], B[k, 26] = v67, v88
        v93 = product(acc[26], A[0, 26], B[0, 26], later, v67, v88)
        v94 = -v92 - v93
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v164 = c15 * v37
                v165 = c16 * v45
            else:
                if magnet.terms == RADIAL:
                    A[k, 27], B[k, 27] = v37, v37
                    v115 = product(acc[27], A[0, 27], B[0, 27], later, v37, v37)
                    A[k, 28], B[k, 28] = v45, v45
                    v116 = product(acc[28], A[0, 28], B[0, 28], later, v45, v45)
                    v117 = c17 * v115 + c17 * v116
                    v118 = c18 * v117 + c19 * z
                    A[k, 29], B[k, 29] = v117, v118
                    v119 = product(acc[29], A[0, 29], B[0, 29], later, v117, v118)
                    v120 = v119 + c20 * z
                    A[k, 30], B[k, 30] = v117, v120
                    v121 = product(acc[30], A[0, 30], B[0, 30], later, v117, v120)
                    v122 = v121 + z
                    A[k, 31], B[k, 31] = v37, v122
                    v129 = product(acc[31], A[0, 31], B[0, 31], later, v37, v122)
                    A[k, 32], B[k, 32] = v45, v122
                    v130 = product(acc[32], A[0, 32], B[0, 32], later, v45, v122)
                    v161 = c15 * v129
                    v162 = c16 * v130
                else:
                    A[k, 69], B[k, 69] = v37, v37
                    v131 = product(acc[69], A[0, 69], B[0, 69], later, v37, v37)
                    A[k, 70], B[k, 70] = v45, v45
                    v132 = product(acc[70], A[0, 70], B[0, 70], later, v45, v45)
                    v133 = c17 * v131 + c17 * v132
                    v134 = c18 * v133 + c19 * z
                    A[k, 71], B[k, 71] = v133, v134
                    v135 = product(acc[71], A[0, 71], B[0, 71], later, v133, v134)
                    v136 = v135 + c20 * z
                    A[k, 72], B[k, 72] = v133, v136
                    v137 = product(acc[72], A[0, 72], B[0, 72], later, v133, v136)
                    v138 = v137 + z
                    square_x, square_y = c21 * v45, c21 * v37
                    wave_x, wave_y = z, 0.0
                    bits, lane, begun = int((magnet.number + -1.0)), 81, False
                    while bits > 0:
                        if bits & 1:
                            if begun:
                                A[k, lane], B[k, lane], A[k, lane + 1], B[k, lane + 1] = wave_x, square_x, wave_y, square_y
                                A[k, lane + 2], B[k, lane + 2], A[k, lane + 3], B[k, lane + 3] = wave_x, square_y, wave_y, square_x
                                one = product(acc[lane], A[0, lane], B[0, lane], later, wave_x, square_x)
                                one -= product(acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, wave_y, square_y)
                                two = product(acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, wave_x, square_y)
                                two += product(acc[lane + 3], A[0, lane + 3], B[0, lane + 3], later, wave_y, square_x)
                                wave_x, wave_y = one, two
                                lane += 4
                            else:
                                wave_x, wave_y, begun = square_x, square_y, True
                        bits >>= 1
                        if bits > 0:
                            A[k, lane], B[k, lane], A[k, lane + 1], B[k, lane + 1] = square_x, square_x, square_y, square_y
                            A[k, lane + 2], B[k, lane + 2] = square_x, square_y
                            one = product(acc[lane], A[0, lane], B[0, lane], later, square_x, square_x)
                            one -= product(acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, square_y, square_y)
                            square_y = 2.0 * product(acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, square_x, square_y)
                            square_x = one
                            lane += 3
                    v146 = wave_x
                    v147 = wave_y
                    A[k, 73], B[k, 73] = v45, v146
                    v148 = product(acc[73], A[0, 73], B[0, 73], later, v45, v146)
                    A[k, 74], B[k, 74] = v37, v147
                    v149 = product(acc[74], A[0, 74], B[0, 74], later, v37, v147)
                    v150 = c21 * v148 + c22 * v149
                    v151 = c23 * v133 + z
                    v152 = c24 * v138 + c25 * v150
                    A[k, 75], B[k, 75] = v37, v152
                    v153 = product(acc[75], A[0, 75], B[0, 75], later, v37, v152)
                    A[k, 76], B[k, 76] = v147, v151
                    v154 = product(acc[76], A[0, 76], B[0, 76], later, v147, v151)
                    v155 = c21 * v153 + c26 * v154
                    A[k, 77], B[k, 77] = v45, v152
                    v156 = product(acc[77], A[0, 77], B[0, 77], later, v45, v152)
                    A[k, 78], B[k, 78] = v146, v151
                    v157 = product(acc[78], A[0, 78], B[0, 78], later, v146, v151)
                    v158 = c22 * v156 + c26 * v157
                    v161 = v155
                    v162 = v158
                v164 = v161
                v165 = v162
            v167 = v164
            v168 = v165
            v170 = c27 * v38
            v171 = c28 * v49
        else:
            v167 = 0.0
            v168 = 0.0
            v170 = 0.0
            v171 = 0.0
        v174 = Y[k, 30]
        v175 = Y[k, 36]
        v176 = Y[k, 37]
        A[k, 33], B[k, 33] = v9, v176
        v177 = product(acc[33], A[0, 33], B[0, 33], later, v9, v176)
        A[k, 34], B[k, 34] = v9, v175
        v178 = product(acc[34], A[0, 34], B[0, 34], later, v9, v175)
        D[k, 36] = v177
        D[k, 37] = -v178
        A[k, 35], B[k, 35] = v9, v177
        v181 = product(acc[35], A[0, 35], B[0, 35], later, v9, v177)
        A[k, 36], B[k, 36] = v9, v178
        v182 = product(acc[36], A[0, 36], B[0, 36], later, v9, v178)
        if levels.inner_house:
            v183 = v4 - v6
            v184 = c29 * v183 + c30 * z
            if north < 0.0:
                v185 = 0.0
            else:
                v185 = v184
            v186 = c31 * v183 + c30 * z
            if north > 0.0:
                v187 = 0.0
            else:
                v187 = v186
            v192 = v3 - v5
            v193 = v10 - v12
            v194 = c32 * v192 + c33 * v193
            v195 = v185 - v187
            v196 = v185
            v197 = v187
            v198 = v194
            v200 = v193
            v202 = c34 * v194
            v203 = c34 * v195
        else:
            v196 = c30 * z
            v197 = c30 * z
            v198 = 0.0
            v200 = 0.0
            v202 = 0.0
            v203 = 0.0
        if levels.outer_house:
            v204 = c35 * v5 + c30 * z
            if east < 0.0:
                v205 = 0.0
            else:
                v205 = v204
            v206 = c36 * v5 + c30 * z
            if east > 0.0:
                v207 = 0.0
            else:
                v207 = v206
            v212 = c37 * v6 + c38 * v13
            v213 = v205 - v207
            v214 = v198 - v213
            v215 = v196 - v197
            v216 = v215 - v212
            v217 = v205
            v218 = v207
            v219 = v212
            v221 = c39 * v214
            v222 = c39 * v216
        else:
            v217 = c30 * z
            v218 = c30 * z
            v219 = 0.0
            v221 = 0.0
            v222 = 0.0
        v223 = Y[k, 29]
        v224 = c40 * v223 + c41 * z
        v225 = v224 - v9
        v226 = v167 + v170
        v227 = c42 * v181 + c43 * v174
        v228 = c21 * v226 + c44 * v227
        v229 = v168 + v171
        v230 = c42 * v182 + c45 * v174
        v231 = c21 * v229 + c44 * v230
        v232 = v231 + c46 * z
        v233 = v228 + c2 * v91
        v234 = v232 + c2 * v94
        A[k, 37], B[k, 37] = v32, v234
        v236 = product(acc[37], A[0, 37], B[0, 37], later, v32, v234)
        A[k, 38], B[k, 38] = v8, v44
        v237 = product(acc[38], A[0, 38], B[0, 38], later, v8, v44)
        v238 = -v236 + c47 * v237
        A[k, 39], B[k, 39] = v8, v43
        v239 = product(acc[39], A[0, 39], B[0, 39], later, v8, v43)
        v240 = c48 * v238 + c49 * v239
        i241 = 1.0 / v29 if k == 0 else i241
        v241 = quotient(acc[40], later * B[0, 40], v29, v240, i241)
        A[k, 40], B[k, 40] = v29, v241
        A[k, 41], B[k, 41] = v29, v233
        v242 = product(acc[41], A[0, 41], B[0, 41], later, v29, v233)
        A[k, 42], B[k, 42] = v42, v234
        v243 = product(acc[42], A[0, 42], B[0, 42], later, v42, v234)
        v244 = v242 + c1 * v243
        A[k, 43], B[k, 43] = v30, v44
        v246 = product(acc[43], A[0, 43], B[0, 43], later, v30, v44)
        v247 = v244 + c50 * v246
        A[k, 44], B[k, 44] = v30, v43
        v250 = product(acc[44], A[0, 44], B[0, 44], later, v30, v43)
        v251 = c48 * v247 + c0 * v250
        A[k, 45], B[k, 45] = v37, v241
        v252 = product(acc[45], A[0, 45], B[0, 45], later, v37, v241)
        A[k, 46], B[k, 46] = v8, v30
        v253 = product(acc[46], A[0, 46], B[0, 46], later, v8, v30)
        v254 = c1 * v252 + c1 * v253
        if inputs.ideal_drive:
            v255 = v254 + c40 * z
            v256 = c50 * v255 + c7 * v88
            v258 = v255
            v259 = v256
        else:
            v257 = c51 * v225 + c52 * v88
            v258 = c53 * v257
            v259 = c51 * v225
        if levels.inner_house:
            v260 = v202 + c34 * v91
            v261 = v203 + c34 * v94
            v262 = v260
            v263 = v261
        else:
            v262 = v202
            v263 = v203
        v264 = v258 - v254
        if levels.outer_house:
            v279 = v217
            v280 = v218
            v281 = v219
        else:
            if levels.inner_house:
                v265 = v196 - v197
                v266 = 0.5 * v198 + c30 * z
                v267 = -0.5 * v198 + c30 * z
                v274 = v266
                v275 = v267
                v276 = v265
            else:
                v268 = -0.5 * v91 + c30 * z
                v269 = 0.5 * v91 + c30 * z
                v274 = v268
                v275 = v269
                v276 = -v94
            v279 = v274
            v280 = v275
            v281 = v276
        v282 = v259 + c52 * v88
        A[k, 47], B[k, 47] = v44, v259
        v283 = product(acc[47], A[0, 47], B[0, 47], later, v44, v259)
        v286 = c43 * v38 + c45 * v49
        A[k, 48], B[k, 48] = v174, v286
        v287 = product(acc[48], A[0, 48], B[0, 48], later, v174, v286)
        A[k, 49], B[k, 49] = v38, v181
        v288 = product(acc[49], A[0, 49], B[0, 49], later, v38, v181)
        A[k, 50], B[k, 50] = v49, v182
        v289 = product(acc[50], A[0, 50], B[0, 50], later, v49, v182)
        v290 = c42 * v288 + c42 * v289
        if contact.gap_counts_outer == 0.0:
            v294 = 0.0
        else:
            A[k, 79], B[k, 79] = v12, v91
            v291 = product(acc[79], A[0, 79], B[0, 79], later, v12, v91)
            A[k, 80], B[k, 80] = v13, v94
            v292 = product(acc[80], A[0, 80], B[0, 80], later, v13, v94)
            v293 = v291 + v292
            v294 = c54 * v293
        A[k, 51], B[k, 51] = v38, v170
        v295 = product(acc[51], A[0, 51], B[0, 51], later, v38, v170)
        A[k, 52], B[k, 52] = v49, v171
        v296 = product(acc[52], A[0, 52], B[0, 52], later, v49, v171)
        v297 = v295 + v296
        A[k, 53], B[k, 53] = v200, v200
        v298 = product(acc[53], A[0, 53], B[0, 53], later, v200, v200)
        A[k, 54], B[k, 54] = v13, v13
        v299 = product(acc[54], A[0, 54], B[0, 54], later, v13, v13)
        v300 = c33 * v298 + c38 * v299
        v301 = v83 - v79
        A[k, 55], B[k, 55] = v71, v301
        v302 = product(acc[55], A[0, 55], B[0, 55], later, v71, v301)
        A[k, 56], B[k, 56] = v75, v88
        v303 = product(acc[56], A[0, 56], B[0, 56], later, v75, v88)
        A[k, 57], B[k, 57] = v29, v236
        v304 = product(acc[57], A[0, 57], B[0, 57], later, v29, v236)
        A[k, 58], B[k, 58] = v37, v282
        v305 = product(acc[58], A[0, 58], B[0, 58], later, v37, v282)
        v306 = -v304 + v305
        A[k, 59], B[k, 59] = v32, v242
        v307 = product(acc[59], A[0, 59], B[0, 59], later, v32, v242)
        A[k, 60], B[k, 60] = v45, v282
        v308 = product(acc[60], A[0, 60], B[0, 60], later, v45, v282)
        v309 = v307 - v308
        A[k, 61], B[k, 61] = v37, v234
        v310 = product(acc[61], A[0, 61], B[0, 61], later, v37, v234)
        A[k, 62], B[k, 62] = v31, v242
        v311 = product(acc[62], A[0, 62], B[0, 62], later, v31, v242)
        v312 = v310 + v311
        A[k, 63], B[k, 63] = v46, v282
        v313 = product(acc[63], A[0, 63], B[0, 63], later, v46, v282)
        v314 = v312 + v313
        v315 = v279 - v280
        v316 = -v91 - v315
        v317 = -v94 - v281
        v318 = Y[k, 31]
        if contact.viscous_damping == 0.0:
            v319 = v80
        else:
            v319 = v82
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
    c9 = contact.stiffness
    c10 = contact.exponent
    c11 = contact.damping_factor / onset
    c12 = contact.viscous_damping
    c13 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c14 = magnet.stiffness * shaft.arm_magnet
    c15 = shaft.arm_magnet * shaft.arm_magnet
    c16 = magnet.a7
    c17 = magnet.a5
    c18 = magnet.a3
    c19 = shaft.arm_magnet
    c20 = -1.0 * shaft.arm_magnet
    c21 = magnet.growth
    c22 = -1.0 * magnet.stiffness
    c23 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c24 = magnet.number * magnet.ripple * magnet.stiffness
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
    c41 = inputs.hammer_force * inputs.hammer_x
    c42 = shaft.arm_disk
    c43 = inputs.hammer_force * inputs.hammer_y
    c44 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c45 = -1.0 * shaft.polar_inertia
    c46 = 1.0 / shaft.transverse_inertia
    c47 = 2.0 * (1.0 if levels.euler else 0.0)
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
    wide = (
        contact.gap_counts_outer != 0.0
        or (contact.exponent != 1.5 and contact.exponent != 1.0)
        or levels.friction == SMOOTHED
        or (inputs.magnet_engaged and magnet.terms == RIPPLED)
    )
    for p in range(128):
        A[0, p] = B[0, p] = 0.0
    z, later = 1.0, 0.0
    for k in range(ORDER):
        for p in range(128):
            acc[p] = 0.0
        if wide:
            for j in range(1, k):
                for p in range(128):
                    acc[p] += A[j, p] * B[k - j, p]
        else:
            for j in range(1, k):
                for p in range(76):
                    acc[p] += A[j, p] * B[k - j, p]
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
        A[k, 0], B[k, 0] = v7, v29
        v30 = product(acc[0], A[0, 0], B[0, 0], later, v7, v29)
        v31 = Y[k, 32]
        v32 = Y[k, 33]
        A[k, 1], B[k, 1] = v7, v32
        v33 = product(acc[1], A[0, 1], B[0, 1], later, v7, v32)
        A[k, 2], B[k, 2] = v7, v31
        v34 = product(acc[2], A[0, 2], B[0, 2], later, v7, v31)
        D[k, 32] = v33
        D[k, 33] = c0 * v34
        v37 = Y[k, 34]
        A[k, 3], B[k, 3] = v8, v29
        v38 = product(acc[3], A[0, 3], B[0, 3], later, v8, v29)
        A[k, 4], B[k, 4] = v8, v37
        v39 = product(acc[4], A[0, 4], B[0, 4], later, v8, v37)
        D[k, 34] = v38
        D[k, 35] = c0 * v39
        A[k, 5], B[k, 5] = v31, v37
        v42 = product(acc[5], A[0, 5], B[0, 5], later, v31, v37)
        A[k, 6], B[k, 6] = v7, v37
        v43 = product(acc[6], A[0, 6], B[0, 6], later, v7, v37)
        v44 = v9 + c1 * v43
        A[k, 7], B[k, 7] = v29, v31
        v45 = product(acc[7], A[0, 7], B[0, 7], later, v29, v31)
        A[k, 8], B[k, 8] = v29, v32
        v46 = product(acc[8], A[0, 8], B[0, 8], later, v29, v32)
        A[k, 9], B[k, 9] = v30, v32
        v47 = product(acc[9], A[0, 9], B[0, 9], later, v30, v32)
        A[k, 10], B[k, 10] = v31, v39
        v48 = product(acc[10], A[0, 10], B[0, 10], later, v31, v39)
        v49 = -v47 + c1 * v48
        v50 = c2 * v37 - v3
        v51 = v50 + c3 * v5
        v52 = v51 + c4 * z
        v53 = c5 * v45 - v4
        v54 = v53 + c3 * v6
        v55 = v54 + c6 * z
        v56 = c2 * v38 - v10
        v57 = v56 + c3 * v12
        v58 = c2 * v49 - v11
        v59 = v58 + c3 * v13
        A[k, 11], B[k, 11] = v52, v52
        v60 = product(acc[11], A[0, 11], B[0, 11], later, v52, v52)
        A[k, 12], B[k, 12] = v55, v55
        v61 = product(acc[12], A[0, 12], B[0, 12], later, v55, v55)
        v62 = v60 + v61
        v63 = math.sqrt(v62) if k == 0 else (v62 - acc[13]) * (0.5 / A[0, 13])
        A[k, 13] = B[k, 13] = v63
        v64 = v63 + c7 * z
        i66 = 1.0 / v63 if k == 0 else i66
        v66 = quotient(acc[14], later * B[0, 14], v63, v52, i66)
        A[k, 14], B[k, 14] = v63, v66
        i67 = 1.0 / v63 if k == 0 else i67
        v67 = quotient(acc[15], later * B[0, 15], v63, v55, i67)
        A[k, 15], B[k, 15] = v63, v67
        A[k, 16], B[k, 16] = v57, v66
        v68 = product(acc[16], A[0, 16], B[0, 16], later, v57, v66)
        A[k, 17], B[k, 17] = v59, v67
        v69 = product(acc[17], A[0, 17], B[0, 17], later, v59, v67)
        v70 = v68 + v69
        A[k, 18], B[k, 18] = v59, v66
        v71 = product(acc[18], A[0, 18], B[0, 18], later, v59, v66)
        A[k, 19], B[k, 19] = v57, v67
        v72 = product(acc[19], A[0, 19], B[0, 19], later, v57, v67)
        v73 = v71 - v72
        v74 = v73 + c8 * v44
        if contact.exponent == 1.5:
            v75 = math.sqrt(v64) if k == 0 else (v64 - acc[20]) * (0.5 / A[0, 20])
            A[k, 20] = B[k, 20] = v75
            A[k, 21], B[k, 21] = v64, v75
            v76 = product(acc[21], A[0, 21], B[0, 21], later, v64, v75)
            v79 = c9 * v76
        else:
            if contact.exponent == 1.0:
                v78 = c9 * v64
            else:
                v77 = v64 ** c10 if k == 0 else (c10 * (acc[76] + k * v64 * B[0, 76]) - acc[77]) / (k * B[0, 77])
                A[k, 76], B[k, 76], A[k, 77], B[k, 77] = k * v64, v77, k * v77, v64
                v78 = c9 * v77
            v79 = v78
        v80 = c11 * v70 + z
        A[k, 22], B[k, 22] = v79, v80
        v81 = product(acc[22], A[0, 22], B[0, 22], later, v79, v80)
        v82 = v81 + c12 * v70
        if slack:
            v83 = 0.0
        else:
            v83 = v82
        A[k, 23], B[k, 23] = v66, v83
        v84 = product(acc[23], A[0, 23], B[0, 23], later, v66, v83)
        A[k, 24], B[k, 24] = v67, v83
        v85 = product(acc[24], A[0, 24], B[0, 24], later, v67, v83)
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v155 = c13 * v37
                v156 = c14 * v45
            else:
                if magnet.terms == RADIAL:
                    A[k, 25], B[k, 25] = v37, v37
                    v106 = product(acc[25], A[0, 25], B[0, 25], later, v37, v37)
                    A[k, 26], B[k, 26] = v45, v45
                    v107 = product(acc[26], A[0, 26], B[0, 26], later, v45, v45)
                    v108 = c15 * v106 + c15 * v107
                    v109 = c16 * v108 + c17 * z
                    A[k, 27], B[k, 27] = v108, v109
                    v110 = product(acc[27], A[0, 27], B[0, 27], later, v108, v109)
                    v111 = v110 + c18 * z
                    A[k, 28], B[k, 28] = v108, v111
                    v112 = product(acc[28], A[0, 28], B[0, 28], later, v108, v111)
                    v113 = v112 + z
                    A[k, 29], B[k, 29] = v37, v113
                    v120 = product(acc[29], A[0, 29], B[0, 29], later, v37, v113)
                    A[k, 30], B[k, 30] = v45, v113
                    v121 = product(acc[30], A[0, 30], B[0, 30], later, v45, v113)
                    v152 = c13 * v120
                    v153 = c14 * v121
                else:
                    A[k, 78], B[k, 78] = v37, v37
                    v122 = product(acc[78], A[0, 78], B[0, 78], later, v37, v37)
                    A[k, 79], B[k, 79] = v45, v45
                    v123 = product(acc[79], A[0, 79], B[0, 79], later, v45, v45)
                    v124 = c15 * v122 + c15 * v123
                    v125 = c16 * v124 + c17 * z
                    A[k, 80], B[k, 80] = v124, v125
                    v126 = product(acc[80], A[0, 80], B[0, 80], later, v124, v125)
                    v127 = v126 + c18 * z
                    A[k, 81], B[k, 81] = v124, v127
                    v128 = product(acc[81], A[0, 81], B[0, 81], later, v124, v127)
                    v129 = v128 + z
                    square_x, square_y = c19 * v45, c19 * v37
                    wave_x, wave_y = z, 0.0
                    bits, lane, begun = int((magnet.number + -1.0)), 90, False
                    while bits > 0:
                        if bits & 1:
                            if begun:
                                A[k, lane], B[k, lane], A[k, lane + 1], B[k, lane + 1] = wave_x, square_x, wave_y, square_y
                                A[k, lane + 2], B[k, lane + 2], A[k, lane + 3], B[k, lane + 3] = wave_x, square_y, wave_y, square_x
                                one = product(acc[lane], A[0, lane], B[0, lane], later, wave_x, square_x)
                                one -= product(acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, wave_y, square_y)
                                two = product(acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, wave_x, square_y)
                                two += product(acc[lane + 3], A[0, lane + 3], B[0, lane + 3], later, wave_y, square_x)
                                wave_x, wave_y = one, two
                                lane += 4
                            else:
                                wave_x, wave_y, begun = square_x, square_y, True
                        bits >>= 1
                        if bits > 0:
                            A[k, lane], B[k, lane], A[k, lane + 1], B[k, lane + 1] = square_x, square_x, square_y, square_y
                            A[k, lane + 2], B[k, lane + 2] = square_x, square_y
                            one = product(acc[lane], A[0, lane], B[0, lane], later, square_x, square_x)
                            one -= product(acc[lane + 1], A[0, lane + 1], B[0, lane + 1], later, square_y, square_y)
                            square_y = 2.0 * product(acc[lane + 2], A[0, lane + 2], B[0, lane + 2], later, square_x, square_y)
                            square_x = one
                            lane += 3
                    v137 = wave_x
                    v138 = wave_y
                    A[k, 82], B[k, 82] = v45, v137
                    v139 = product(acc[82], A[0, 82], B[0, 82], later, v45, v137)
                    A[k, 83], B[k, 83] = v37, v138
                    v140 = product(acc[83], A[0, 83], B[0, 83], later, v37, v138)
                    v141 = c19 * v139 + c20 * v140
                    v142 = c21 * v124 + z
                    v143 = c22 * v129 + c23 * v141
                    A[k, 84], B[k, 84] = v37, v143
                    v144 = product(acc[84], A[0, 84], B[0, 84], later, v37, v143)
                    A[k, 85], B[k, 85] = v138, v142
                    v145 = product(acc[85], A[0, 85], B[0, 85], later, v138, v142)
                    v146 = c19 * v144 + c24 * v145
                    A[k, 86], B[k, 86] = v45, v143
                    v147 = product(acc[86], A[0, 86], B[0, 86], later, v45, v143)
                    A[k, 87], B[k, 87] = v137, v142
                    v148 = product(acc[87], A[0, 87], B[0, 87], later, v137, v142)
                    v149 = c20 * v147 + c24 * v148
                    v152 = v146
                    v153 = v149
                v155 = v152
                v156 = v153
            v158 = v155
            v159 = v156
            v161 = c25 * v38
            v162 = c26 * v49
        else:
            v158 = 0.0
            v159 = 0.0
            v161 = 0.0
            v162 = 0.0
        v165 = Y[k, 30]
        v166 = Y[k, 36]
        v167 = Y[k, 37]
        A[k, 31], B[k, 31] = v9, v167
        v168 = product(acc[31], A[0, 31], B[0, 31], later, v9, v167)
        A[k, 32], B[k, 32] = v9, v166
        v169 = product(acc[32], A[0, 32], B[0, 32], later, v9, v166)
        D[k, 36] = v168
        D[k, 37] = -v169
        A[k, 33], B[k, 33] = v9, v168
        v172 = product(acc[33], A[0, 33], B[0, 33], later, v9, v168)
        A[k, 34], B[k, 34] = v9, v169
        v173 = product(acc[34], A[0, 34], B[0, 34], later, v9, v169)
        if levels.inner_house:
            v174 = v4 - v6
            v175 = c27 * v174 + c28 * z
            if north < 0.0:
                v176 = 0.0
            else:
                v176 = v175
            v177 = c29 * v174 + c28 * z
            if north > 0.0:
                v178 = 0.0
            else:
                v178 = v177
            v183 = v3 - v5
            v184 = v10 - v12
            v185 = c30 * v183 + c31 * v184
            v186 = v176 - v178
            v187 = v176
            v188 = v178
            v189 = v185
            v191 = v184
            v193 = c32 * v185
            v194 = c32 * v186
        else:
            v187 = c28 * z
            v188 = c28 * z
            v189 = 0.0
            v191 = 0.0
            v193 = 0.0
            v194 = 0.0
        if levels.outer_house:
            v195 = c33 * v5 + c28 * z
            if east < 0.0:
                v196 = 0.0
            else:
                v196 = v195
            v197 = c34 * v5 + c28 * z
            if east > 0.0:
                v198 = 0.0
            else:
                v198 = v197
            v203 = c35 * v6 + c36 * v13
            v204 = v196 - v198
            v205 = v189 - v204
            v206 = v187 - v188
            v207 = v206 - v203
            v208 = v196
            v209 = v198
            v210 = v203
            v212 = c37 * v205
            v213 = c37 * v207
        else:
            v208 = c28 * z
            v209 = c28 * z
            v210 = 0.0
            v212 = 0.0
            v213 = 0.0
        v214 = Y[k, 29]
        v215 = c38 * v214 + c39 * z
        v216 = v215 - v9
        v217 = v158 + v161
        v218 = c40 * v172 + c41 * v165
        v219 = c19 * v217 + c42 * v218
        v220 = v159 + v162
        v221 = c40 * v173 + c43 * v165
        v222 = c19 * v220 + c42 * v221
        v223 = v222 + c44 * z
        A[k, 35], B[k, 35] = v8, v44
        v228 = product(acc[35], A[0, 35], B[0, 35], later, v8, v44)
        A[k, 36], B[k, 36] = v8, v43
        v230 = product(acc[36], A[0, 36], B[0, 36], later, v8, v43)
        A[k, 37], B[k, 37] = v30, v44
        v237 = product(acc[37], A[0, 37], B[0, 37], later, v30, v44)
        A[k, 38], B[k, 38] = v7, v7
        v239 = product(acc[38], A[0, 38], B[0, 38], later, v7, v7)
        A[k, 39], B[k, 39] = v30, v43
        v241 = product(acc[39], A[0, 39], B[0, 39], later, v30, v43)
        A[k, 40], B[k, 40] = v8, v30
        v244 = product(acc[40], A[0, 40], B[0, 40], later, v8, v30)
        v254 = 0.0
        A[k, 41], B[k, 41] = v67, v254
        v255 = product(acc[41], A[0, 41], B[0, 41], later, v67, v254)
        v256 = -v84 + v255
        A[k, 42], B[k, 42] = v66, v254
        v257 = product(acc[42], A[0, 42], B[0, 42], later, v66, v254)
        v258 = -v85 - v257
        v259 = v219 + c2 * v256
        v260 = v223 + c2 * v258
        A[k, 43], B[k, 43] = v32, v260
        v261 = product(acc[43], A[0, 43], B[0, 43], later, v32, v260)
        v262 = -v261 + c45 * v228
        v263 = c46 * v262 + c47 * v230
        i264 = 1.0 / v29 if k == 0 else i264
        v264 = quotient(acc[44], later * B[0, 44], v29, v263, i264)
        A[k, 44], B[k, 44] = v29, v264
        A[k, 45], B[k, 45] = v29, v259
        v265 = product(acc[45], A[0, 45], B[0, 45], later, v29, v259)
        A[k, 46], B[k, 46] = v42, v260
        v266 = product(acc[46], A[0, 46], B[0, 46], later, v42, v260)
        v267 = v265 + c1 * v266
        v268 = v267 + c48 * v237
        v269 = c46 * v268 + c0 * v241
        A[k, 47], B[k, 47] = v37, v264
        v270 = product(acc[47], A[0, 47], B[0, 47], later, v37, v264)
        v271 = c1 * v270 + c1 * v244
        if inputs.ideal_drive:
            v272 = v271 + c38 * z
            v275 = v272
        else:
            v274 = c49 * v216 + c50 * v254
            v275 = c51 * v274
        if levels.inner_house:
            v277 = v193 + c32 * v256
            v278 = v194 + c32 * v258
            v279 = v277
            v280 = v278
        else:
            v279 = v193
            v280 = v194
        if levels.outer_house:
            pass
        else:
            if levels.inner_house:
                v282 = v187 - v188
                v283 = 0.5 * v189 + c28 * z
                v284 = -0.5 * v189 + c28 * z
            else:
                pass
        v303 = c41 * v38 + c43 * v49
        A[k, 49], B[k, 49] = v165, v303
        v304 = product(acc[49], A[0, 49], B[0, 49], later, v165, v303)
        A[k, 50], B[k, 50] = v38, v172
        v305 = product(acc[50], A[0, 50], B[0, 50], later, v38, v172)
        A[k, 51], B[k, 51] = v49, v173
        v306 = product(acc[51], A[0, 51], B[0, 51], later, v49, v173)
        v307 = c40 * v305 + c40 * v306
        A[k, 52], B[k, 52] = v38, v161
        v312 = product(acc[52], A[0, 52], B[0, 52], later, v38, v161)
        A[k, 53], B[k, 53] = v49, v162
        v313 = product(acc[53], A[0, 53], B[0, 53], later, v49, v162)
        v314 = v312 + v313
        A[k, 54], B[k, 54] = v191, v191
        v315 = product(acc[54], A[0, 54], B[0, 54], later, v191, v191)
        A[k, 55], B[k, 55] = v13, v13
        v316 = product(acc[55], A[0, 55], B[0, 55], later, v13, v13)
        v317 = c31 * v315 + c36 * v316
        v318 = v83 - v79
        A[k, 56], B[k, 56] = v70, v318
        v319 = product(acc[56], A[0, 56], B[0, 56], later, v70, v318)
        A[k, 65], B[k, 65] = v8, v8
        v335 = product(acc[65], A[0, 65], B[0, 65], later, v8, v8)
        v336 = v239 + v335
        A[k, 66], B[k, 66] = v29, v269
        v337 = product(acc[66], A[0, 66], B[0, 66], later, v29, v269)
        A[k, 67], B[k, 67] = v37, v335
        v338 = product(acc[67], A[0, 67], B[0, 67], later, v37, v335)
        v339 = v337 + c0 * v338
        A[k, 68], B[k, 68] = v46, v264
        v340 = product(acc[68], A[0, 68], B[0, 68], later, v46, v264)
        A[k, 69], B[k, 69] = v42, v269
        v341 = product(acc[69], A[0, 69], B[0, 69], later, v42, v269)
        v342 = -v340 + c1 * v341
        A[k, 70], B[k, 70] = v45, v336
        v343 = product(acc[70], A[0, 70], B[0, 70], later, v45, v336)
        v344 = v342 + c1 * v343
        A[k, 71], B[k, 71] = v33, v39
        v346 = product(acc[71], A[0, 71], B[0, 71], later, v33, v39)
        v347 = v344 + c47 * v346
        v355 = c2 * v339 - v279
        v356 = v355 + c3 * v212
        v357 = c2 * v347 - v280
        v358 = v357 + c3 * v213
        A[k, 72], B[k, 72] = v66, v358
        v359 = product(acc[72], A[0, 72], B[0, 72], later, v66, v358)
        A[k, 73], B[k, 73] = v67, v356
        v360 = product(acc[73], A[0, 73], B[0, 73], later, v67, v356)
        v361 = v359 - v360
        A[k, 74], B[k, 74] = v70, v73
        v362 = product(acc[74], A[0, 74], B[0, 74], later, v70, v73)
        i363 = 1.0 / v63 if k == 0 else i363
        v363 = quotient(acc[75], later * B[0, 75], v63, v362, i363)
        A[k, 75], B[k, 75] = v63, v363
        v364 = v361 - v363
        v365 = v364 + c8 * v275
        v366 = Y[k, 31]
        friction = v365 * per_friction
        v254 = friction
        A[k, 41], B[k, 41] = v67, v254
        v255 = product(acc[41], A[0, 41], B[0, 41], later, v67, v254)
        v256 = -v84 + v255
        A[k, 42], B[k, 42] = v66, v254
        v257 = product(acc[42], A[0, 42], B[0, 42], later, v66, v254)
        v258 = -v85 - v257
        v259 = v219 + c2 * v256
        v260 = v223 + c2 * v258
        A[k, 43], B[k, 43] = v32, v260
        v261 = product(acc[43], A[0, 43], B[0, 43], later, v32, v260)
        v262 = -v261 + c45 * v228
        v263 = c46 * v262 + c47 * v230
        i264 = 1.0 / v29 if k == 0 else i264
        v264 = quotient(acc[44], later * B[0, 44], v29, v263, i264)
        A[k, 44], B[k, 44] = v29, v264
        A[k, 45], B[k, 45] = v29, v259
        v265 = product(acc[45], A[0, 45], B[0, 45], later, v29, v259)
        A[k, 46], B[k, 46] = v42, v260
        v266 = product(acc[46], A[0, 46], B[0, 46], later, v42, v260)
        v267 = v265 + c1 * v266
        v268 = v267 + c48 * v237
        v269 = c46 * v268 + c0 * v241
        A[k, 47], B[k, 47] = v37, v264
        v270 = product(acc[47], A[0, 47], B[0, 47], later, v37, v264)
        v271 = c1 * v270 + c1 * v244
        if inputs.ideal_drive:
            v272 = v271 + c38 * z
            v273 = c48 * v272 + c8 * v254
            v275 = v272
            v276 = v273
        else:
            v274 = c49 * v216 + c50 * v254
            v275 = c51 * v274
            v276 = c49 * v216
        if levels.inner_house:
            v277 = v193 + c32 * v256
            v278 = v194 + c32 * v258
            v279 = v277
            v280 = v278
        else:
            v279 = v193
            v280 = v194
        v281 = v275 - v271
        if levels.outer_house:
            v296 = v208
            v297 = v209
            v298 = v210
        else:
            if levels.inner_house:
                v291 = v283
                v292 = v284
                v293 = v282
            else:
                v285 = -0.5 * v256 + c28 * z
                v286 = 0.5 * v256 + c28 * z
                v291 = v285
                v292 = v286
                v293 = -v258
            v296 = v291
            v297 = v292
            v298 = v293
        v299 = v276 + c50 * v254
        A[k, 48], B[k, 48] = v44, v276
        v300 = product(acc[48], A[0, 48], B[0, 48], later, v44, v276)
        if contact.gap_counts_outer == 0.0:
            v311 = 0.0
        else:
            A[k, 88], B[k, 88] = v12, v256
            v308 = product(acc[88], A[0, 88], B[0, 88], later, v12, v256)
            A[k, 89], B[k, 89] = v13, v258
            v309 = product(acc[89], A[0, 89], B[0, 89], later, v13, v258)
            v310 = v308 + v309
            v311 = c52 * v310
        A[k, 57], B[k, 57] = v74, v254
        v320 = product(acc[57], A[0, 57], B[0, 57], later, v74, v254)
        A[k, 58], B[k, 58] = v29, v261
        v321 = product(acc[58], A[0, 58], B[0, 58], later, v29, v261)
        A[k, 59], B[k, 59] = v37, v299
        v322 = product(acc[59], A[0, 59], B[0, 59], later, v37, v299)
        v323 = -v321 + v322
        A[k, 60], B[k, 60] = v32, v265
        v324 = product(acc[60], A[0, 60], B[0, 60], later, v32, v265)
        A[k, 61], B[k, 61] = v45, v299
        v325 = product(acc[61], A[0, 61], B[0, 61], later, v45, v299)
        v326 = v324 - v325
        A[k, 62], B[k, 62] = v37, v260
        v327 = product(acc[62], A[0, 62], B[0, 62], later, v37, v260)
        A[k, 63], B[k, 63] = v31, v265
        v328 = product(acc[63], A[0, 63], B[0, 63], later, v31, v265)
        v329 = v327 + v328
        A[k, 64], B[k, 64] = v46, v299
        v330 = product(acc[64], A[0, 64], B[0, 64], later, v46, v299)
        v331 = v329 + v330
        v332 = v296 - v297
        v333 = -v256 - v332
        v334 = -v258 - v298
        A[k, 66], B[k, 66] = v29, v269
        v337 = product(acc[66], A[0, 66], B[0, 66], later, v29, v269)
        v339 = v337 + c0 * v338
        A[k, 68], B[k, 68] = v46, v264
        v340 = product(acc[68], A[0, 68], B[0, 68], later, v46, v264)
        A[k, 69], B[k, 69] = v42, v269
        v341 = product(acc[69], A[0, 69], B[0, 69], later, v42, v269)
        v342 = -v340 + c1 * v341
        v344 = v342 + c1 * v343
        v347 = v344 + c47 * v346
        v355 = c2 * v339 - v279
        v356 = v355 + c3 * v212
        v357 = c2 * v347 - v280
        v358 = v357 + c3 * v213
        A[k, 72], B[k, 72] = v66, v358
        v359 = product(acc[72], A[0, 72], B[0, 72], later, v66, v358)
        A[k, 73], B[k, 73] = v67, v356
        v360 = product(acc[73], A[0, 73], B[0, 73], later, v67, v356)
        v361 = v359 - v360
        v364 = v361 - v363
        v365 = v364 + c8 * v275
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
