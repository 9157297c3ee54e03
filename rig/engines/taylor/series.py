"""Coefficients of the Taylor series, by phase. Made by `rig.engines.tape.taylor`: do not edit."""

from __future__ import annotations

import math

from numba import njit

from rig.engines.taylor.place import EAST, NORTH, ONSET, ORDER, PHASE, SLACK
from rig.kernels.contact import BACKWARD, EXACT, FLIGHT, FORWARD, NO_FRICTION, ROLLING, SMOOTHED, TOUCHING  # noqa: F401
from rig.kernels.magnet import LINEAR, RADIAL, RIPPLED  # noqa: F401


@njit(cache=True, error_model="numpy", forceinline=True)
def product(below, left_0, right_0, later, left, right):
    """The k-th coefficient of a product; `later` is 0 for k = 0, else 1. No array goes in: that counts references."""
    return below + left_0 * right + left * (later * right_0)


@njit(cache=True, error_model="numpy", forceinline=True)
def quotient(below, first, divisor, dividend, inverse):
    """The k-th coefficient of a quotient that begins with `first` (given as 0 for k = 0), by the inverse of the divisor's."""
    return (dividend - below - divisor * first) * inverse


LANES = 136


@njit(cache=True, error_model="numpy")
def flight(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Flight: 57 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east = memory[NORTH], memory[EAST]
    c0 = shaft.arm_ring
    c1 = -1.0 * contact.gap_counts_outer
    c2 = -1.0 * contact.offset_x
    c3 = -1.0 * contact.offset_y
    c4 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c5 = shaft.arm_magnet * shaft.arm_magnet
    c6 = magnet.a7
    c7 = magnet.a5
    c8 = magnet.a3
    c9 = -1.0 * shaft.arm_magnet
    c10 = shaft.arm_magnet
    c11 = magnet.growth
    c12 = -1.0 * magnet.stiffness
    c13 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c14 = magnet.number * magnet.ripple * magnet.stiffness
    c15 = -1.0 * magnet.damping_x * shaft.arm_magnet
    c16 = -1.0 * magnet.damping_y * shaft.arm_magnet
    c17 = 0.5 * house.pair_stiffness_vertical
    c18 = house.preload
    c19 = -0.5 * house.pair_stiffness_vertical
    c20 = house.inner_beam_stiffness
    c21 = house.inner_beam_damping
    c22 = -1.0 / house.inner_mass
    c23 = 0.5 * house.pair_stiffness_horizontal
    c24 = -0.5 * house.pair_stiffness_horizontal
    c25 = house.outer_beam_stiffness
    c26 = house.outer_beam_damping
    c27 = 1.0 / house.outer_mass
    c28 = inputs.speed_slope
    c29 = aim
    c30 = shaft.unbalance
    c31 = inputs.hammer_force * inputs.hammer_x
    c32 = shaft.arm_disk
    c33 = inputs.hammer_force * inputs.hammer_y
    c34 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c35 = -1.0 * shaft.polar_inertia
    c36 = 1.0 / shaft.transverse_inertia
    c37 = shaft.polar_inertia
    c38 = constants.torque_gain / shaft.polar_inertia
    c39 = constants.torque_gain
    c40 = pulse
    c41 = -1.0 * pulse
    i234 = 0.0
    Y[0, 29] = 0.0
    Y[0, 30], Y[0, 31] = math.sin(along), math.cos(along)
    turned = Y[0, 0]
    Y[0, 32], Y[0, 33] = math.sin(turned), math.cos(turned)
    turned = Y[0, 1]
    Y[0, 34], Y[0, 35] = math.sin(turned), math.cos(turned)
    turned = Y[0, 2] + shaft.unbalance_phase
    Y[0, 36], Y[0, 37] = math.sin(turned), math.cos(turned)
    wide = inputs.magnet_engaged and magnet.terms == RIPPLED
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
                for p in range(64):
                    acc[p] += A[j, p] * B[k - j, p]
        D[k, 32] = D[k, 33] = D[k, 34] = D[k, 35] = D[k, 36] = D[k, 37] = 0.0
        v0 = Y[k, 0]
        v1 = Y[k, 1]
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
        if levels.euler:
            v29 = Y[k, 32]
            v30 = Y[k, 33]
            A[k, 0], B[k, 0] = v7, v30
            v31 = product(acc[0], A[0, 0], B[0, 0], later, v7, v30)
            A[k, 1], B[k, 1] = v7, v29
            v32 = product(acc[1], A[0, 1], B[0, 1], later, v7, v29)
            D[k, 32] = v31
            D[k, 33] = -v32
            v35 = Y[k, 34]
            v36 = Y[k, 35]
            A[k, 2], B[k, 2] = v8, v36
            v37 = product(acc[2], A[0, 2], B[0, 2], later, v8, v36)
            A[k, 3], B[k, 3] = v8, v35
            v38 = product(acc[3], A[0, 3], B[0, 3], later, v8, v35)
            D[k, 34] = v37
            D[k, 35] = -v38
            A[k, 4], B[k, 4] = v29, v35
            v41 = product(acc[4], A[0, 4], B[0, 4], later, v29, v35)
            A[k, 5], B[k, 5] = v29, v36
            v42 = product(acc[5], A[0, 5], B[0, 5], later, v29, v36)
            A[k, 6], B[k, 6] = v30, v36
            v43 = product(acc[6], A[0, 6], B[0, 6], later, v30, v36)
            A[k, 7], B[k, 7] = v7, v35
            v44 = product(acc[7], A[0, 7], B[0, 7], later, v7, v35)
            v45 = v9 + v44
            A[k, 8], B[k, 8] = v7, v43
            v46 = product(acc[8], A[0, 8], B[0, 8], later, v7, v43)
            A[k, 9], B[k, 9] = v8, v41
            v47 = product(acc[9], A[0, 9], B[0, 9], later, v8, v41)
            v48 = -v46 + v47
            v50 = v30
            v51 = v35
            v52 = v36
            v53 = v45
            v54 = v41
            v55 = v35
            v56 = -v42
            v57 = v43
            v58 = v37
            v59 = v48
        else:
            v50 = z
            v51 = v1
            v52 = z
            v53 = v9
            v54 = 0.0
            v55 = v1
            v56 = -v0
            v57 = z
            v58 = v8
            v59 = -v7
        v60 = c0 * v55 - v3
        v61 = v60 + c1 * v5
        v62 = v61 + c2 * z
        v63 = c0 * v56 - v4
        v64 = v63 + c1 * v6
        v65 = v64 + c3 * z
        A[k, 10], B[k, 10] = v62, v62
        v70 = product(acc[10], A[0, 10], B[0, 10], later, v62, v62)
        A[k, 11], B[k, 11] = v65, v65
        v71 = product(acc[11], A[0, 11], B[0, 11], later, v65, v65)
        v72 = v70 + v71
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v154 = c4 * v55
                v155 = c4 * v56
            else:
                if magnet.terms == RADIAL:
                    A[k, 12], B[k, 12] = v55, v55
                    v105 = product(acc[12], A[0, 12], B[0, 12], later, v55, v55)
                    A[k, 13], B[k, 13] = v56, v56
                    v106 = product(acc[13], A[0, 13], B[0, 13], later, v56, v56)
                    v107 = c5 * v105 + c5 * v106
                    v108 = c6 * v107 + c7 * z
                    A[k, 14], B[k, 14] = v107, v108
                    v109 = product(acc[14], A[0, 14], B[0, 14], later, v107, v108)
                    v110 = v109 + c8 * z
                    A[k, 15], B[k, 15] = v107, v110
                    v111 = product(acc[15], A[0, 15], B[0, 15], later, v107, v110)
                    v112 = v111 + z
                    A[k, 16], B[k, 16] = v55, v112
                    v119 = product(acc[16], A[0, 16], B[0, 16], later, v55, v112)
                    A[k, 17], B[k, 17] = v56, v112
                    v120 = product(acc[17], A[0, 17], B[0, 17], later, v56, v112)
                    v151 = c4 * v119
                    v152 = c4 * v120
                else:
                    A[k, 12], B[k, 12] = v55, v55
                    v121 = product(acc[12], A[0, 12], B[0, 12], later, v55, v55)
                    A[k, 13], B[k, 13] = v56, v56
                    v122 = product(acc[13], A[0, 13], B[0, 13], later, v56, v56)
                    v123 = c5 * v121 + c5 * v122
                    v124 = c6 * v123 + c7 * z
                    A[k, 14], B[k, 14] = v123, v124
                    v125 = product(acc[14], A[0, 14], B[0, 14], later, v123, v124)
                    v126 = v125 + c8 * z
                    A[k, 15], B[k, 15] = v123, v126
                    v127 = product(acc[15], A[0, 15], B[0, 15], later, v123, v126)
                    v128 = v127 + z
                    square_x, square_y = c9 * v56, c10 * v55
                    wave_x, wave_y = z, 0.0
                    bits, lane, begun = int((magnet.number + -1.0)), 57, False
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
                    v136 = wave_x
                    v137 = wave_y
                    A[k, 16], B[k, 16] = v56, v136
                    v138 = product(acc[16], A[0, 16], B[0, 16], later, v56, v136)
                    A[k, 17], B[k, 17] = v55, v137
                    v139 = product(acc[17], A[0, 17], B[0, 17], later, v55, v137)
                    v140 = c9 * v138 + c9 * v139
                    v141 = c11 * v123 + z
                    v142 = c12 * v128 + c13 * v140
                    A[k, 18], B[k, 18] = v55, v142
                    v143 = product(acc[18], A[0, 18], B[0, 18], later, v55, v142)
                    A[k, 19], B[k, 19] = v137, v141
                    v144 = product(acc[19], A[0, 19], B[0, 19], later, v137, v141)
                    v145 = c10 * v143 + c14 * v144
                    A[k, 20], B[k, 20] = v56, v142
                    v146 = product(acc[20], A[0, 20], B[0, 20], later, v56, v142)
                    A[k, 21], B[k, 21] = v136, v141
                    v147 = product(acc[21], A[0, 21], B[0, 21], later, v136, v141)
                    v148 = c10 * v146 + c14 * v147
                    v151 = v145
                    v152 = v148
                v154 = v151
                v155 = v152
            v157 = v154
            v158 = v155
            v160 = c15 * v58
            v161 = c16 * v59
        else:
            v157 = 0.0
            v158 = 0.0
            v160 = 0.0
            v161 = 0.0
        A[k, 22], B[k, 22] = v9, v9
        v162 = product(acc[22], A[0, 22], B[0, 22], later, v9, v9)
        v164 = Y[k, 30]
        v165 = Y[k, 36]
        v166 = Y[k, 37]
        A[k, 23], B[k, 23] = v9, v166
        v167 = product(acc[23], A[0, 23], B[0, 23], later, v9, v166)
        A[k, 24], B[k, 24] = v9, v165
        v168 = product(acc[24], A[0, 24], B[0, 24], later, v9, v165)
        D[k, 36] = v167
        D[k, 37] = -v168
        A[k, 25], B[k, 25] = v162, v166
        v171 = product(acc[25], A[0, 25], B[0, 25], later, v162, v166)
        A[k, 26], B[k, 26] = v162, v165
        v172 = product(acc[26], A[0, 26], B[0, 26], later, v162, v165)
        if levels.inner_house:
            v173 = v4 - v6
            v174 = c17 * v173 + c18 * z
            if north < 0.0:
                v175 = 0.0
            else:
                v175 = v174
            v176 = c19 * v173 + c18 * z
            if north > 0.0:
                v177 = 0.0
            else:
                v177 = v176
            v182 = v3 - v5
            v183 = v10 - v12
            v184 = c20 * v182 + c21 * v183
            v185 = v175 - v177
            v186 = v175
            v187 = v177
            v188 = v184
            v190 = v183
            v192 = c22 * v184
            v193 = c22 * v185
        else:
            v186 = c18 * z
            v187 = c18 * z
            v188 = 0.0
            v190 = 0.0
            v192 = 0.0
            v193 = 0.0
        if levels.outer_house:
            v194 = c23 * v5 + c18 * z
            if east < 0.0:
                v195 = 0.0
            else:
                v195 = v194
            v196 = c24 * v5 + c18 * z
            if east > 0.0:
                v197 = 0.0
            else:
                v197 = v196
            v202 = c25 * v6 + c26 * v13
            v203 = v195 - v197
            v204 = v188 - v203
            v205 = v186 - v187
            v206 = v205 - v202
            v207 = v195
            v208 = v197
            v209 = v202
            v211 = c27 * v204
            v212 = c27 * v206
        else:
            v207 = c18 * z
            v208 = c18 * z
            v209 = 0.0
            v211 = 0.0
            v212 = 0.0
        v213 = Y[k, 29]
        v214 = c28 * v213 + c29 * z
        v215 = v214 - v9
        v216 = v157 + v160
        v217 = c30 * v171 + c31 * v164
        v218 = c10 * v216 + c32 * v217
        v219 = v158 + v161
        v220 = c30 * v172 + c33 * v164
        v221 = c10 * v219 + c32 * v220
        v222 = v221 + c34 * z
        if levels.euler:
            A[k, 27], B[k, 27] = v7, v8
            v223 = product(acc[27], A[0, 27], B[0, 27], later, v7, v8)
            A[k, 28], B[k, 28] = v7, v7
            v224 = product(acc[28], A[0, 28], B[0, 28], later, v7, v7)
            A[k, 29], B[k, 29] = v51, v224
            v225 = product(acc[29], A[0, 29], B[0, 29], later, v51, v224)
            A[k, 30], B[k, 30] = v52, v225
            v226 = product(acc[30], A[0, 30], B[0, 30], later, v52, v225)
            v227 = v223
            v228 = v226
        else:
            v227 = 0.0
            v228 = 0.0
        A[k, 31], B[k, 31] = v50, v222
        v229 = product(acc[31], A[0, 31], B[0, 31], later, v50, v222)
        A[k, 32], B[k, 32] = v8, v53
        v230 = product(acc[32], A[0, 32], B[0, 32], later, v8, v53)
        v231 = -v229 + c35 * v230
        A[k, 33], B[k, 33] = v51, v227
        v232 = product(acc[33], A[0, 33], B[0, 33], later, v51, v227)
        v233 = c36 * v231 + 2.0 * v232
        i234 = 1.0 / v52 if k == 0 else i234
        v234 = quotient(acc[34], later * B[0, 34], v52, v233, i234)
        A[k, 34], B[k, 34] = v52, v234
        A[k, 35], B[k, 35] = v52, v218
        v235 = product(acc[35], A[0, 35], B[0, 35], later, v52, v218)
        A[k, 36], B[k, 36] = v54, v222
        v236 = product(acc[36], A[0, 36], B[0, 36], later, v54, v222)
        v237 = v235 + v236
        A[k, 37], B[k, 37] = v7, v53
        v238 = product(acc[37], A[0, 37], B[0, 37], later, v7, v53)
        A[k, 38], B[k, 38] = v52, v238
        v239 = product(acc[38], A[0, 38], B[0, 38], later, v52, v238)
        v240 = v237 + c37 * v239
        v241 = c36 * v240 - v228
        if levels.euler:
            A[k, 39], B[k, 39] = v51, v234
            v242 = product(acc[39], A[0, 39], B[0, 39], later, v51, v234)
            A[k, 40], B[k, 40] = v52, v227
            v243 = product(acc[40], A[0, 40], B[0, 40], later, v52, v227)
            v244 = v242 + v243
            v245 = v244
        else:
            v245 = 0.0
        if inputs.ideal_drive:
            v246 = v245 + c28 * z
            v247 = v246
            v248 = c37 * v246
        else:
            v247 = c38 * v215
            v248 = c39 * v215
        v249 = v247 - v245
        if levels.outer_house:
            v260 = v207
            v261 = v208
            v262 = v209
        else:
            if levels.inner_house:
                v250 = v186 - v187
                v251 = 0.5 * v188 + c18 * z
                v252 = -0.5 * v188 + c18 * z
                v255 = v251
                v256 = v252
                v257 = v250
            else:
                v255 = c18 * z
                v256 = c18 * z
                v257 = 0.0
            v260 = v255
            v261 = v256
            v262 = v257
        A[k, 41], B[k, 41] = v53, v248
        v263 = product(acc[41], A[0, 41], B[0, 41], later, v53, v248)
        A[k, 42], B[k, 42] = v58, v164
        v264 = product(acc[42], A[0, 42], B[0, 42], later, v58, v164)
        A[k, 43], B[k, 43] = v59, v164
        v265 = product(acc[43], A[0, 43], B[0, 43], later, v59, v164)
        v266 = c31 * v264 + c33 * v265
        A[k, 44], B[k, 44] = v58, v171
        v267 = product(acc[44], A[0, 44], B[0, 44], later, v58, v171)
        A[k, 45], B[k, 45] = v59, v172
        v268 = product(acc[45], A[0, 45], B[0, 45], later, v59, v172)
        v269 = c30 * v267 + c30 * v268
        A[k, 46], B[k, 46] = v58, v160
        v270 = product(acc[46], A[0, 46], B[0, 46], later, v58, v160)
        A[k, 47], B[k, 47] = v59, v161
        v271 = product(acc[47], A[0, 47], B[0, 47], later, v59, v161)
        v272 = v270 + v271
        A[k, 48], B[k, 48] = v190, v190
        v273 = product(acc[48], A[0, 48], B[0, 48], later, v190, v190)
        A[k, 49], B[k, 49] = v13, v13
        v274 = product(acc[49], A[0, 49], B[0, 49], later, v13, v13)
        v275 = c21 * v273 + c26 * v274
        A[k, 50], B[k, 50] = v57, v222
        v276 = product(acc[50], A[0, 50], B[0, 50], later, v57, v222)
        A[k, 51], B[k, 51] = v55, v248
        v277 = product(acc[51], A[0, 51], B[0, 51], later, v55, v248)
        v278 = -v276 + v277
        A[k, 52], B[k, 52] = v57, v218
        v279 = product(acc[52], A[0, 52], B[0, 52], later, v57, v218)
        A[k, 53], B[k, 53] = v56, v248
        v280 = product(acc[53], A[0, 53], B[0, 53], later, v56, v248)
        v281 = v279 + v280
        A[k, 54], B[k, 54] = v55, v222
        v282 = product(acc[54], A[0, 54], B[0, 54], later, v55, v222)
        A[k, 55], B[k, 55] = v56, v218
        v283 = product(acc[55], A[0, 55], B[0, 55], later, v56, v218)
        v284 = v282 - v283
        A[k, 56], B[k, 56] = v57, v248
        v285 = product(acc[56], A[0, 56], B[0, 56], later, v57, v248)
        v286 = v284 + v285
        v287 = v260 - v261
        v288 = Y[k, 31]
        D[k, 0] = v7
        D[k, 1] = v8
        D[k, 2] = v9
        D[k, 3] = v10
        D[k, 4] = v11
        D[k, 5] = v12
        D[k, 6] = v13
        D[k, 7] = v234
        D[k, 8] = v241
        D[k, 9] = v249
        D[k, 10] = v192
        D[k, 11] = v193
        D[k, 12] = v211
        D[k, 13] = v212
        D[k, 14] = v263
        D[k, 15] = c32 * v266
        D[k, 16] = c32 * v269
        D[k, 17] = 0.0
        D[k, 18] = 0.0
        D[k, 19] = c9 * v272
        D[k, 20] = v275
        D[k, 21] = 0.0
        D[k, 22] = 0.0
        D[k, 23] = 0.0
        D[k, 24] = v278
        D[k, 25] = v281
        D[k, 26] = v286
        D[k, 27] = -v287
        D[k, 28] = -v262
        D[k, 29] = z
        D[k, 30] = c40 * v288
        D[k, 31] = c41 * v164
        Y[k, 39] = 0.0
        Y[k, 40] = v72
        Y[k, 41] = 0.0
        Y[k, 42] = 0.0
        portion = 1.0 / (k + 1.0)
        for i in range(38):
            Y[k + 1, i] = D[k, i] * portion
        Y[k + 1, 38] = 0.0
        z, later = 0.0, 1.0
    for i in range(39, 43):
        Y[ORDER, i] = 0.0


@njit(cache=True, error_model="numpy")
def sliding(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Sliding: 79 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east = memory[NORTH], memory[EAST]
    c0 = shaft.arm_ring
    c1 = -1.0 * contact.gap_counts_outer
    c2 = -1.0 * contact.offset_x
    c3 = -1.0 * contact.offset_y
    c4 = shaft.radius
    c5 = contact.stiffness
    c6 = 2.0 * contact.exponent
    c7 = contact.damping_factor / onset
    c8 = contact.viscous_damping
    c9 = contact.friction
    c10 = -1.0 * contact.friction
    c11 = 1.0 / contact.smoothing_speed
    c12 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c13 = shaft.arm_magnet * shaft.arm_magnet
    c14 = magnet.a7
    c15 = magnet.a5
    c16 = magnet.a3
    c17 = -1.0 * shaft.arm_magnet
    c18 = shaft.arm_magnet
    c19 = magnet.growth
    c20 = -1.0 * magnet.stiffness
    c21 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c22 = magnet.number * magnet.ripple * magnet.stiffness
    c23 = -1.0 * magnet.damping_x * shaft.arm_magnet
    c24 = -1.0 * magnet.damping_y * shaft.arm_magnet
    c25 = 0.5 * house.pair_stiffness_vertical
    c26 = house.preload
    c27 = -0.5 * house.pair_stiffness_vertical
    c28 = house.inner_beam_stiffness
    c29 = house.inner_beam_damping
    c30 = -1.0 / house.inner_mass
    c31 = 0.5 * house.pair_stiffness_horizontal
    c32 = -0.5 * house.pair_stiffness_horizontal
    c33 = house.outer_beam_stiffness
    c34 = house.outer_beam_damping
    c35 = 1.0 / house.outer_mass
    c36 = inputs.speed_slope
    c37 = aim
    c38 = shaft.unbalance
    c39 = inputs.hammer_force * inputs.hammer_x
    c40 = shaft.arm_disk
    c41 = inputs.hammer_force * inputs.hammer_y
    c42 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c43 = -1.0 * shaft.polar_inertia
    c44 = 1.0 / shaft.transverse_inertia
    c45 = shaft.polar_inertia
    c46 = constants.torque_gain
    c47 = -1.0 * shaft.radius
    c48 = 1.0 / shaft.polar_inertia
    c49 = contact.gap_counts_outer
    c50 = pulse
    c51 = -1.0 * pulse
    i77 = 0.0
    i78 = 0.0
    i256 = 0.0
    Y[0, 29] = 0.0
    Y[0, 30], Y[0, 31] = math.sin(along), math.cos(along)
    turned = Y[0, 0]
    Y[0, 32], Y[0, 33] = math.sin(turned), math.cos(turned)
    turned = Y[0, 1]
    Y[0, 34], Y[0, 35] = math.sin(turned), math.cos(turned)
    turned = Y[0, 2] + shaft.unbalance_phase
    Y[0, 36], Y[0, 37] = math.sin(turned), math.cos(turned)
    wide = inputs.magnet_engaged and magnet.terms == RIPPLED
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
                for p in range(80):
                    acc[p] += A[j, p] * B[k - j, p]
        D[k, 32] = D[k, 33] = D[k, 34] = D[k, 35] = D[k, 36] = D[k, 37] = 0.0
        v0 = Y[k, 0]
        v1 = Y[k, 1]
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
        if levels.euler:
            v29 = Y[k, 32]
            v30 = Y[k, 33]
            A[k, 0], B[k, 0] = v7, v30
            v31 = product(acc[0], A[0, 0], B[0, 0], later, v7, v30)
            A[k, 1], B[k, 1] = v7, v29
            v32 = product(acc[1], A[0, 1], B[0, 1], later, v7, v29)
            D[k, 32] = v31
            D[k, 33] = -v32
            v35 = Y[k, 34]
            v36 = Y[k, 35]
            A[k, 2], B[k, 2] = v8, v36
            v37 = product(acc[2], A[0, 2], B[0, 2], later, v8, v36)
            A[k, 3], B[k, 3] = v8, v35
            v38 = product(acc[3], A[0, 3], B[0, 3], later, v8, v35)
            D[k, 34] = v37
            D[k, 35] = -v38
            A[k, 4], B[k, 4] = v29, v35
            v41 = product(acc[4], A[0, 4], B[0, 4], later, v29, v35)
            A[k, 5], B[k, 5] = v29, v36
            v42 = product(acc[5], A[0, 5], B[0, 5], later, v29, v36)
            A[k, 6], B[k, 6] = v30, v36
            v43 = product(acc[6], A[0, 6], B[0, 6], later, v30, v36)
            A[k, 7], B[k, 7] = v7, v35
            v44 = product(acc[7], A[0, 7], B[0, 7], later, v7, v35)
            v45 = v9 + v44
            A[k, 8], B[k, 8] = v7, v43
            v46 = product(acc[8], A[0, 8], B[0, 8], later, v7, v43)
            A[k, 9], B[k, 9] = v8, v41
            v47 = product(acc[9], A[0, 9], B[0, 9], later, v8, v41)
            v48 = -v46 + v47
            v50 = v30
            v51 = v35
            v52 = v36
            v53 = v45
            v54 = v41
            v55 = v35
            v56 = -v42
            v57 = v43
            v58 = v37
            v59 = v48
        else:
            v50 = z
            v51 = v1
            v52 = z
            v53 = v9
            v54 = 0.0
            v55 = v1
            v56 = -v0
            v57 = z
            v58 = v8
            v59 = -v7
        v60 = c0 * v55 - v3
        v61 = v60 + c1 * v5
        v62 = v61 + c2 * z
        v63 = c0 * v56 - v4
        v64 = v63 + c1 * v6
        v65 = v64 + c3 * z
        v66 = c0 * v58 - v10
        v67 = v66 + c1 * v12
        v68 = c0 * v59 - v11
        v69 = v68 + c1 * v13
        A[k, 10], B[k, 10] = v62, v62
        v70 = product(acc[10], A[0, 10], B[0, 10], later, v62, v62)
        A[k, 11], B[k, 11] = v65, v65
        v71 = product(acc[11], A[0, 11], B[0, 11], later, v65, v65)
        v72 = v70 + v71
        v73 = math.sqrt(v72) if k == 0 else (v72 - acc[12]) * (0.5 / A[0, 12])
        A[k, 12] = B[k, 12] = v73
        v74 = Y[k, 38]
        A[k, 13], B[k, 13] = v74, v74
        v75 = product(acc[13], A[0, 13], B[0, 13], later, v74, v74)
        i77 = 1.0 / v73 if k == 0 else i77
        v77 = quotient(acc[14], later * B[0, 14], v73, v62, i77)
        A[k, 14], B[k, 14] = v73, v77
        i78 = 1.0 / v73 if k == 0 else i78
        v78 = quotient(acc[15], later * B[0, 15], v73, v65, i78)
        A[k, 15], B[k, 15] = v73, v78
        A[k, 16], B[k, 16] = v67, v77
        v79 = product(acc[16], A[0, 16], B[0, 16], later, v67, v77)
        A[k, 17], B[k, 17] = v69, v78
        v80 = product(acc[17], A[0, 17], B[0, 17], later, v69, v78)
        v81 = v79 + v80
        A[k, 18], B[k, 18] = v69, v77
        v82 = product(acc[18], A[0, 18], B[0, 18], later, v69, v77)
        A[k, 19], B[k, 19] = v67, v78
        v83 = product(acc[19], A[0, 19], B[0, 19], later, v67, v78)
        v84 = v82 - v83
        v85 = v84 + c4 * v53
        if contact.exponent == 1.5:
            A[k, 20], B[k, 20] = v74, v75
            v86 = product(acc[20], A[0, 20], B[0, 20], later, v74, v75)
            v89 = c5 * v86
        else:
            if contact.exponent == 1.0:
                v88 = c5 * v75
            else:
                v87 = v74 ** c6 if k == 0 else (c6 * (acc[20] + k * v74 * B[0, 20]) - acc[21]) / (k * B[0, 21])
                A[k, 20], B[k, 20], A[k, 21], B[k, 21] = k * v74, v87, k * v87, v74
                v88 = c5 * v87
            v89 = v88
        v90 = c7 * v81 + z
        A[k, 22], B[k, 22] = v89, v90
        v91 = product(acc[22], A[0, 22], B[0, 22], later, v89, v90)
        v92 = v91 + c8 * v81
        if slack:
            v93 = 0.0
        else:
            v93 = v92
        if phase == FORWARD:
            v98 = c9 * v93
        else:
            if phase == BACKWARD:
                v97 = c10 * v93
            else:
                if levels.friction == SMOOTHED:
                    v94 = math.tanh(c11 * v85) if k == 0 else (acc[23] + k * (c11 * v85) * B[0, 23]) / k
                    A[k, 23] = k * (c11 * v85)
                    A[k, 24], B[k, 24] = v94, v94
                    B[k, 23] = z - product(acc[24], A[0, 24], B[0, 24], later, v94, v94)
                    A[k, 25], B[k, 25] = v93, v94
                    v95 = product(acc[25], A[0, 25], B[0, 25], later, v93, v94)
                    v96 = c9 * v95
                else:
                    v96 = 0.0
                v97 = v96
            v98 = v97
        A[k, 26], B[k, 26] = v77, v93
        v99 = product(acc[26], A[0, 26], B[0, 26], later, v77, v93)
        A[k, 27], B[k, 27] = v78, v98
        v100 = product(acc[27], A[0, 27], B[0, 27], later, v78, v98)
        v101 = -v99 + v100
        A[k, 28], B[k, 28] = v78, v93
        v102 = product(acc[28], A[0, 28], B[0, 28], later, v78, v93)
        A[k, 29], B[k, 29] = v77, v98
        v103 = product(acc[29], A[0, 29], B[0, 29], later, v77, v98)
        v104 = -v102 - v103
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v174 = c12 * v55
                v175 = c12 * v56
            else:
                if magnet.terms == RADIAL:
                    A[k, 30], B[k, 30] = v55, v55
                    v125 = product(acc[30], A[0, 30], B[0, 30], later, v55, v55)
                    A[k, 31], B[k, 31] = v56, v56
                    v126 = product(acc[31], A[0, 31], B[0, 31], later, v56, v56)
                    v127 = c13 * v125 + c13 * v126
                    v128 = c14 * v127 + c15 * z
                    A[k, 32], B[k, 32] = v127, v128
                    v129 = product(acc[32], A[0, 32], B[0, 32], later, v127, v128)
                    v130 = v129 + c16 * z
                    A[k, 33], B[k, 33] = v127, v130
                    v131 = product(acc[33], A[0, 33], B[0, 33], later, v127, v130)
                    v132 = v131 + z
                    A[k, 34], B[k, 34] = v55, v132
                    v139 = product(acc[34], A[0, 34], B[0, 34], later, v55, v132)
                    A[k, 35], B[k, 35] = v56, v132
                    v140 = product(acc[35], A[0, 35], B[0, 35], later, v56, v132)
                    v171 = c12 * v139
                    v172 = c12 * v140
                else:
                    A[k, 30], B[k, 30] = v55, v55
                    v141 = product(acc[30], A[0, 30], B[0, 30], later, v55, v55)
                    A[k, 31], B[k, 31] = v56, v56
                    v142 = product(acc[31], A[0, 31], B[0, 31], later, v56, v56)
                    v143 = c13 * v141 + c13 * v142
                    v144 = c14 * v143 + c15 * z
                    A[k, 32], B[k, 32] = v143, v144
                    v145 = product(acc[32], A[0, 32], B[0, 32], later, v143, v144)
                    v146 = v145 + c16 * z
                    A[k, 33], B[k, 33] = v143, v146
                    v147 = product(acc[33], A[0, 33], B[0, 33], later, v143, v146)
                    v148 = v147 + z
                    square_x, square_y = c17 * v56, c18 * v55
                    wave_x, wave_y = z, 0.0
                    bits, lane, begun = int((magnet.number + -1.0)), 79, False
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
                    v156 = wave_x
                    v157 = wave_y
                    A[k, 34], B[k, 34] = v56, v156
                    v158 = product(acc[34], A[0, 34], B[0, 34], later, v56, v156)
                    A[k, 35], B[k, 35] = v55, v157
                    v159 = product(acc[35], A[0, 35], B[0, 35], later, v55, v157)
                    v160 = c17 * v158 + c17 * v159
                    v161 = c19 * v143 + z
                    v162 = c20 * v148 + c21 * v160
                    A[k, 36], B[k, 36] = v55, v162
                    v163 = product(acc[36], A[0, 36], B[0, 36], later, v55, v162)
                    A[k, 37], B[k, 37] = v157, v161
                    v164 = product(acc[37], A[0, 37], B[0, 37], later, v157, v161)
                    v165 = c18 * v163 + c22 * v164
                    A[k, 38], B[k, 38] = v56, v162
                    v166 = product(acc[38], A[0, 38], B[0, 38], later, v56, v162)
                    A[k, 39], B[k, 39] = v156, v161
                    v167 = product(acc[39], A[0, 39], B[0, 39], later, v156, v161)
                    v168 = c18 * v166 + c22 * v167
                    v171 = v165
                    v172 = v168
                v174 = v171
                v175 = v172
            v177 = v174
            v178 = v175
            v180 = c23 * v58
            v181 = c24 * v59
        else:
            v177 = 0.0
            v178 = 0.0
            v180 = 0.0
            v181 = 0.0
        A[k, 40], B[k, 40] = v9, v9
        v182 = product(acc[40], A[0, 40], B[0, 40], later, v9, v9)
        v184 = Y[k, 30]
        v185 = Y[k, 36]
        v186 = Y[k, 37]
        A[k, 41], B[k, 41] = v9, v186
        v187 = product(acc[41], A[0, 41], B[0, 41], later, v9, v186)
        A[k, 42], B[k, 42] = v9, v185
        v188 = product(acc[42], A[0, 42], B[0, 42], later, v9, v185)
        D[k, 36] = v187
        D[k, 37] = -v188
        A[k, 43], B[k, 43] = v182, v186
        v191 = product(acc[43], A[0, 43], B[0, 43], later, v182, v186)
        A[k, 44], B[k, 44] = v182, v185
        v192 = product(acc[44], A[0, 44], B[0, 44], later, v182, v185)
        if levels.inner_house:
            v193 = v4 - v6
            v194 = c25 * v193 + c26 * z
            if north < 0.0:
                v195 = 0.0
            else:
                v195 = v194
            v196 = c27 * v193 + c26 * z
            if north > 0.0:
                v197 = 0.0
            else:
                v197 = v196
            v202 = v3 - v5
            v203 = v10 - v12
            v204 = c28 * v202 + c29 * v203
            v205 = v195 - v197
            v206 = v195
            v207 = v197
            v208 = v204
            v210 = v203
            v212 = c30 * v204
            v213 = c30 * v205
        else:
            v206 = c26 * z
            v207 = c26 * z
            v208 = 0.0
            v210 = 0.0
            v212 = 0.0
            v213 = 0.0
        if levels.outer_house:
            v214 = c31 * v5 + c26 * z
            if east < 0.0:
                v215 = 0.0
            else:
                v215 = v214
            v216 = c32 * v5 + c26 * z
            if east > 0.0:
                v217 = 0.0
            else:
                v217 = v216
            v222 = c33 * v6 + c34 * v13
            v223 = v215 - v217
            v224 = v208 - v223
            v225 = v206 - v207
            v226 = v225 - v222
            v227 = v215
            v228 = v217
            v229 = v222
            v231 = c35 * v224
            v232 = c35 * v226
        else:
            v227 = c26 * z
            v228 = c26 * z
            v229 = 0.0
            v231 = 0.0
            v232 = 0.0
        v233 = Y[k, 29]
        v234 = c36 * v233 + c37 * z
        v235 = v234 - v9
        v236 = v177 + v180
        v237 = c38 * v191 + c39 * v184
        v238 = c18 * v236 + c40 * v237
        v239 = v178 + v181
        v240 = c38 * v192 + c41 * v184
        v241 = c18 * v239 + c40 * v240
        v242 = v241 + c42 * z
        v243 = v238 + c0 * v101
        v244 = v242 + c0 * v104
        if levels.euler:
            A[k, 45], B[k, 45] = v7, v8
            v245 = product(acc[45], A[0, 45], B[0, 45], later, v7, v8)
            A[k, 46], B[k, 46] = v7, v7
            v246 = product(acc[46], A[0, 46], B[0, 46], later, v7, v7)
            A[k, 47], B[k, 47] = v51, v246
            v247 = product(acc[47], A[0, 47], B[0, 47], later, v51, v246)
            A[k, 48], B[k, 48] = v52, v247
            v248 = product(acc[48], A[0, 48], B[0, 48], later, v52, v247)
            v249 = v245
            v250 = v248
        else:
            v249 = 0.0
            v250 = 0.0
        A[k, 49], B[k, 49] = v50, v244
        v251 = product(acc[49], A[0, 49], B[0, 49], later, v50, v244)
        A[k, 50], B[k, 50] = v8, v53
        v252 = product(acc[50], A[0, 50], B[0, 50], later, v8, v53)
        v253 = -v251 + c43 * v252
        A[k, 51], B[k, 51] = v51, v249
        v254 = product(acc[51], A[0, 51], B[0, 51], later, v51, v249)
        v255 = c44 * v253 + 2.0 * v254
        i256 = 1.0 / v52 if k == 0 else i256
        v256 = quotient(acc[52], later * B[0, 52], v52, v255, i256)
        A[k, 52], B[k, 52] = v52, v256
        A[k, 53], B[k, 53] = v52, v243
        v257 = product(acc[53], A[0, 53], B[0, 53], later, v52, v243)
        A[k, 54], B[k, 54] = v54, v244
        v258 = product(acc[54], A[0, 54], B[0, 54], later, v54, v244)
        v259 = v257 + v258
        A[k, 55], B[k, 55] = v7, v53
        v260 = product(acc[55], A[0, 55], B[0, 55], later, v7, v53)
        A[k, 56], B[k, 56] = v52, v260
        v261 = product(acc[56], A[0, 56], B[0, 56], later, v52, v260)
        v262 = v259 + c45 * v261
        v263 = c44 * v262 - v250
        if levels.euler:
            A[k, 57], B[k, 57] = v51, v256
            v264 = product(acc[57], A[0, 57], B[0, 57], later, v51, v256)
            A[k, 58], B[k, 58] = v52, v249
            v265 = product(acc[58], A[0, 58], B[0, 58], later, v52, v249)
            v266 = v264 + v265
            v267 = v266
        else:
            v267 = 0.0
        if inputs.ideal_drive:
            v268 = v267 + c36 * z
            v269 = c45 * v268 + c4 * v98
            v271 = v268
            v272 = v269
        else:
            v270 = c46 * v235 + c47 * v98
            v271 = c48 * v270
            v272 = c46 * v235
        if levels.inner_house:
            v273 = v212 + c30 * v101
            v274 = v213 + c30 * v104
            v275 = v273
            v276 = v274
        else:
            v275 = v212
            v276 = v213
        v277 = v271 - v267
        if levels.outer_house:
            v292 = v227
            v293 = v228
            v294 = v229
        else:
            if levels.inner_house:
                v278 = v206 - v207
                v279 = 0.5 * v208 + c26 * z
                v280 = -0.5 * v208 + c26 * z
                v287 = v279
                v288 = v280
                v289 = v278
            else:
                v281 = -0.5 * v101 + c26 * z
                v282 = 0.5 * v101 + c26 * z
                v287 = v281
                v288 = v282
                v289 = -v104
            v292 = v287
            v293 = v288
            v294 = v289
        v295 = v272 + c47 * v98
        A[k, 59], B[k, 59] = v53, v272
        v296 = product(acc[59], A[0, 59], B[0, 59], later, v53, v272)
        A[k, 60], B[k, 60] = v58, v184
        v297 = product(acc[60], A[0, 60], B[0, 60], later, v58, v184)
        A[k, 61], B[k, 61] = v59, v184
        v298 = product(acc[61], A[0, 61], B[0, 61], later, v59, v184)
        v299 = c39 * v297 + c41 * v298
        A[k, 62], B[k, 62] = v58, v191
        v300 = product(acc[62], A[0, 62], B[0, 62], later, v58, v191)
        A[k, 63], B[k, 63] = v59, v192
        v301 = product(acc[63], A[0, 63], B[0, 63], later, v59, v192)
        v302 = c38 * v300 + c38 * v301
        A[k, 64], B[k, 64] = v12, v101
        v303 = product(acc[64], A[0, 64], B[0, 64], later, v12, v101)
        A[k, 65], B[k, 65] = v13, v104
        v304 = product(acc[65], A[0, 65], B[0, 65], later, v13, v104)
        v305 = v303 + v304
        A[k, 66], B[k, 66] = v58, v180
        v306 = product(acc[66], A[0, 66], B[0, 66], later, v58, v180)
        A[k, 67], B[k, 67] = v59, v181
        v307 = product(acc[67], A[0, 67], B[0, 67], later, v59, v181)
        v308 = v306 + v307
        A[k, 68], B[k, 68] = v210, v210
        v309 = product(acc[68], A[0, 68], B[0, 68], later, v210, v210)
        A[k, 69], B[k, 69] = v13, v13
        v310 = product(acc[69], A[0, 69], B[0, 69], later, v13, v13)
        v311 = c29 * v309 + c34 * v310
        v312 = v93 - v89
        A[k, 70], B[k, 70] = v81, v312
        v313 = product(acc[70], A[0, 70], B[0, 70], later, v81, v312)
        A[k, 71], B[k, 71] = v85, v98
        v314 = product(acc[71], A[0, 71], B[0, 71], later, v85, v98)
        A[k, 72], B[k, 72] = v57, v244
        v315 = product(acc[72], A[0, 72], B[0, 72], later, v57, v244)
        A[k, 73], B[k, 73] = v55, v295
        v316 = product(acc[73], A[0, 73], B[0, 73], later, v55, v295)
        v317 = -v315 + v316
        A[k, 74], B[k, 74] = v57, v243
        v318 = product(acc[74], A[0, 74], B[0, 74], later, v57, v243)
        A[k, 75], B[k, 75] = v56, v295
        v319 = product(acc[75], A[0, 75], B[0, 75], later, v56, v295)
        v320 = v318 + v319
        A[k, 76], B[k, 76] = v55, v244
        v321 = product(acc[76], A[0, 76], B[0, 76], later, v55, v244)
        A[k, 77], B[k, 77] = v56, v243
        v322 = product(acc[77], A[0, 77], B[0, 77], later, v56, v243)
        v323 = v321 - v322
        A[k, 78], B[k, 78] = v57, v295
        v324 = product(acc[78], A[0, 78], B[0, 78], later, v57, v295)
        v325 = v323 + v324
        v326 = v292 - v293
        v327 = -v101 - v326
        v328 = -v104 - v294
        v329 = Y[k, 31]
        if contact.viscous_damping == 0.0:
            v330 = v90
        else:
            v330 = v92
        D[k, 0] = v7
        D[k, 1] = v8
        D[k, 2] = v9
        D[k, 3] = v10
        D[k, 4] = v11
        D[k, 5] = v12
        D[k, 6] = v13
        D[k, 7] = v256
        D[k, 8] = v263
        D[k, 9] = v277
        D[k, 10] = v275
        D[k, 11] = v276
        D[k, 12] = v231
        D[k, 13] = v232
        D[k, 14] = v296
        D[k, 15] = c40 * v299
        D[k, 16] = c40 * v302
        D[k, 17] = c49 * v305
        D[k, 18] = 0.0
        D[k, 19] = c17 * v308
        D[k, 20] = v311
        D[k, 21] = v313
        D[k, 22] = v314
        D[k, 23] = v93
        D[k, 24] = v317
        D[k, 25] = v320
        D[k, 26] = v325
        D[k, 27] = v327
        D[k, 28] = v328
        D[k, 29] = z
        D[k, 30] = c50 * v329
        D[k, 31] = c51 * v184
        Y[k, 39] = v93
        Y[k, 40] = 0.0
        Y[k, 41] = v85
        Y[k, 42] = v330
        portion = 1.0 / (k + 1.0)
        for i in range(38):
            Y[k + 1, i] = 0.0
        for j in range(k + 1):
            slow = Y[k - j, 38] * portion
            for i in range(38):
                Y[k + 1, i] += slow * D[j, i]
        Y[k + 1, 38] = 0.5 * v81 * portion
        z, later = 0.0, 1.0
    for i in range(39, 43):
        Y[ORDER, i] = 0.0


@njit(cache=True, error_model="numpy")
def rolling(constants, inputs, memory, aim, pulse, along, per_friction, Y, A, B, D, acc):
    """Rolling: 93 lanes."""
    levels, shaft, magnet = constants.levels, constants.shaft, constants.magnet
    contact, house = constants.contact, constants.house
    phase, onset, slack = int(memory[PHASE]), memory[ONSET], memory[SLACK] != 0.0
    north, east = memory[NORTH], memory[EAST]
    c0 = shaft.arm_ring
    c1 = -1.0 * contact.gap_counts_outer
    c2 = -1.0 * contact.offset_x
    c3 = -1.0 * contact.offset_y
    c4 = -1.0 * contact.clearance
    c5 = shaft.radius
    c6 = contact.stiffness
    c7 = contact.exponent
    c8 = contact.damping_factor / onset
    c9 = contact.viscous_damping
    c10 = -1.0 * magnet.stiffness * shaft.arm_magnet
    c11 = shaft.arm_magnet * shaft.arm_magnet
    c12 = magnet.a7
    c13 = magnet.a5
    c14 = magnet.a3
    c15 = -1.0 * shaft.arm_magnet
    c16 = shaft.arm_magnet
    c17 = magnet.growth
    c18 = -1.0 * magnet.stiffness
    c19 = -2.0 * magnet.growth * magnet.ripple * magnet.stiffness
    c20 = magnet.number * magnet.ripple * magnet.stiffness
    c21 = -1.0 * magnet.damping_x * shaft.arm_magnet
    c22 = -1.0 * magnet.damping_y * shaft.arm_magnet
    c23 = 0.5 * house.pair_stiffness_vertical
    c24 = house.preload
    c25 = -0.5 * house.pair_stiffness_vertical
    c26 = house.inner_beam_stiffness
    c27 = house.inner_beam_damping
    c28 = -1.0 / house.inner_mass
    c29 = 0.5 * house.pair_stiffness_horizontal
    c30 = -0.5 * house.pair_stiffness_horizontal
    c31 = house.outer_beam_stiffness
    c32 = house.outer_beam_damping
    c33 = 1.0 / house.outer_mass
    c34 = inputs.speed_slope
    c35 = aim
    c36 = shaft.unbalance
    c37 = inputs.hammer_force * inputs.hammer_x
    c38 = shaft.arm_disk
    c39 = inputs.hammer_force * inputs.hammer_y
    c40 = -1.0 * shaft.arm_centre * shaft.gravity * shaft.mass
    c41 = -1.0 * shaft.polar_inertia
    c42 = 1.0 / shaft.transverse_inertia
    c43 = shaft.polar_inertia
    c44 = constants.torque_gain
    c45 = -1.0 * shaft.radius
    c46 = 1.0 / shaft.polar_inertia
    c47 = contact.gap_counts_outer
    c48 = pulse
    c49 = -1.0 * pulse
    i76 = 0.0
    i77 = 0.0
    i284 = 0.0
    i392 = 0.0
    Y[0, 29] = 0.0
    Y[0, 30], Y[0, 31] = math.sin(along), math.cos(along)
    turned = Y[0, 0]
    Y[0, 32], Y[0, 33] = math.sin(turned), math.cos(turned)
    turned = Y[0, 1]
    Y[0, 34], Y[0, 35] = math.sin(turned), math.cos(turned)
    turned = Y[0, 2] + shaft.unbalance_phase
    Y[0, 36], Y[0, 37] = math.sin(turned), math.cos(turned)
    wide = inputs.magnet_engaged and magnet.terms == RIPPLED
    for p in range(136):
        A[0, p] = B[0, p] = 0.0
    z, later = 1.0, 0.0
    for k in range(ORDER):
        for p in range(136):
            acc[p] = 0.0
        if wide:
            for j in range(1, k):
                for p in range(136):
                    acc[p] += A[j, p] * B[k - j, p]
        else:
            for j in range(1, k):
                for p in range(96):
                    acc[p] += A[j, p] * B[k - j, p]
        D[k, 32] = D[k, 33] = D[k, 34] = D[k, 35] = D[k, 36] = D[k, 37] = 0.0
        v0 = Y[k, 0]
        v1 = Y[k, 1]
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
        if levels.euler:
            v29 = Y[k, 32]
            v30 = Y[k, 33]
            A[k, 0], B[k, 0] = v7, v30
            v31 = product(acc[0], A[0, 0], B[0, 0], later, v7, v30)
            A[k, 1], B[k, 1] = v7, v29
            v32 = product(acc[1], A[0, 1], B[0, 1], later, v7, v29)
            D[k, 32] = v31
            D[k, 33] = -v32
            v35 = Y[k, 34]
            v36 = Y[k, 35]
            A[k, 2], B[k, 2] = v8, v36
            v37 = product(acc[2], A[0, 2], B[0, 2], later, v8, v36)
            A[k, 3], B[k, 3] = v8, v35
            v38 = product(acc[3], A[0, 3], B[0, 3], later, v8, v35)
            D[k, 34] = v37
            D[k, 35] = -v38
            A[k, 4], B[k, 4] = v29, v35
            v41 = product(acc[4], A[0, 4], B[0, 4], later, v29, v35)
            A[k, 5], B[k, 5] = v29, v36
            v42 = product(acc[5], A[0, 5], B[0, 5], later, v29, v36)
            A[k, 6], B[k, 6] = v30, v36
            v43 = product(acc[6], A[0, 6], B[0, 6], later, v30, v36)
            A[k, 7], B[k, 7] = v7, v35
            v44 = product(acc[7], A[0, 7], B[0, 7], later, v7, v35)
            v45 = v9 + v44
            A[k, 8], B[k, 8] = v7, v43
            v46 = product(acc[8], A[0, 8], B[0, 8], later, v7, v43)
            A[k, 9], B[k, 9] = v8, v41
            v47 = product(acc[9], A[0, 9], B[0, 9], later, v8, v41)
            v48 = -v46 + v47
            v49 = v29
            v50 = v30
            v51 = v35
            v52 = v36
            v53 = v45
            v54 = v41
            v55 = v35
            v56 = -v42
            v57 = v43
            v58 = v37
            v59 = v48
        else:
            v49 = v0
            v50 = z
            v51 = v1
            v52 = z
            v53 = v9
            v54 = 0.0
            v55 = v1
            v56 = -v0
            v57 = z
            v58 = v8
            v59 = -v7
        v60 = c0 * v55 - v3
        v61 = v60 + c1 * v5
        v62 = v61 + c2 * z
        v63 = c0 * v56 - v4
        v64 = v63 + c1 * v6
        v65 = v64 + c3 * z
        v66 = c0 * v58 - v10
        v67 = v66 + c1 * v12
        v68 = c0 * v59 - v11
        v69 = v68 + c1 * v13
        A[k, 10], B[k, 10] = v62, v62
        v70 = product(acc[10], A[0, 10], B[0, 10], later, v62, v62)
        A[k, 11], B[k, 11] = v65, v65
        v71 = product(acc[11], A[0, 11], B[0, 11], later, v65, v65)
        v72 = v70 + v71
        v73 = math.sqrt(v72) if k == 0 else (v72 - acc[12]) * (0.5 / A[0, 12])
        A[k, 12] = B[k, 12] = v73
        v74 = v73 + c4 * z
        i76 = 1.0 / v73 if k == 0 else i76
        v76 = quotient(acc[13], later * B[0, 13], v73, v62, i76)
        A[k, 13], B[k, 13] = v73, v76
        i77 = 1.0 / v73 if k == 0 else i77
        v77 = quotient(acc[14], later * B[0, 14], v73, v65, i77)
        A[k, 14], B[k, 14] = v73, v77
        A[k, 15], B[k, 15] = v67, v76
        v78 = product(acc[15], A[0, 15], B[0, 15], later, v67, v76)
        A[k, 16], B[k, 16] = v69, v77
        v79 = product(acc[16], A[0, 16], B[0, 16], later, v69, v77)
        v80 = v78 + v79
        A[k, 17], B[k, 17] = v69, v76
        v81 = product(acc[17], A[0, 17], B[0, 17], later, v69, v76)
        A[k, 18], B[k, 18] = v67, v77
        v82 = product(acc[18], A[0, 18], B[0, 18], later, v67, v77)
        v83 = v81 - v82
        v84 = v83 + c5 * v53
        if contact.exponent == 1.5:
            v85 = math.sqrt(v74) if k == 0 else (v74 - acc[19]) * (0.5 / A[0, 19])
            A[k, 19] = B[k, 19] = v85
            A[k, 20], B[k, 20] = v74, v85
            v86 = product(acc[20], A[0, 20], B[0, 20], later, v74, v85)
            v89 = c6 * v86
        else:
            if contact.exponent == 1.0:
                v88 = c6 * v74
            else:
                v87 = v74 ** c7 if k == 0 else (c7 * (acc[19] + k * v74 * B[0, 19]) - acc[20]) / (k * B[0, 20])
                A[k, 19], B[k, 19], A[k, 20], B[k, 20] = k * v74, v87, k * v87, v74
                v88 = c6 * v87
            v89 = v88
        v90 = c8 * v80 + z
        A[k, 21], B[k, 21] = v89, v90
        v91 = product(acc[21], A[0, 21], B[0, 21], later, v89, v90)
        v92 = v91 + c9 * v80
        if slack:
            v93 = 0.0
        else:
            v93 = v92
        A[k, 22], B[k, 22] = v76, v93
        v94 = product(acc[22], A[0, 22], B[0, 22], later, v76, v93)
        A[k, 23], B[k, 23] = v77, v93
        v95 = product(acc[23], A[0, 23], B[0, 23], later, v77, v93)
        if inputs.magnet_engaged:
            if magnet.terms == LINEAR:
                v165 = c10 * v55
                v166 = c10 * v56
            else:
                if magnet.terms == RADIAL:
                    A[k, 24], B[k, 24] = v55, v55
                    v116 = product(acc[24], A[0, 24], B[0, 24], later, v55, v55)
                    A[k, 25], B[k, 25] = v56, v56
                    v117 = product(acc[25], A[0, 25], B[0, 25], later, v56, v56)
                    v118 = c11 * v116 + c11 * v117
                    v119 = c12 * v118 + c13 * z
                    A[k, 26], B[k, 26] = v118, v119
                    v120 = product(acc[26], A[0, 26], B[0, 26], later, v118, v119)
                    v121 = v120 + c14 * z
                    A[k, 27], B[k, 27] = v118, v121
                    v122 = product(acc[27], A[0, 27], B[0, 27], later, v118, v121)
                    v123 = v122 + z
                    A[k, 28], B[k, 28] = v55, v123
                    v130 = product(acc[28], A[0, 28], B[0, 28], later, v55, v123)
                    A[k, 29], B[k, 29] = v56, v123
                    v131 = product(acc[29], A[0, 29], B[0, 29], later, v56, v123)
                    v162 = c10 * v130
                    v163 = c10 * v131
                else:
                    A[k, 24], B[k, 24] = v55, v55
                    v132 = product(acc[24], A[0, 24], B[0, 24], later, v55, v55)
                    A[k, 25], B[k, 25] = v56, v56
                    v133 = product(acc[25], A[0, 25], B[0, 25], later, v56, v56)
                    v134 = c11 * v132 + c11 * v133
                    v135 = c12 * v134 + c13 * z
                    A[k, 26], B[k, 26] = v134, v135
                    v136 = product(acc[26], A[0, 26], B[0, 26], later, v134, v135)
                    v137 = v136 + c14 * z
                    A[k, 27], B[k, 27] = v134, v137
                    v138 = product(acc[27], A[0, 27], B[0, 27], later, v134, v137)
                    v139 = v138 + z
                    square_x, square_y = c15 * v56, c16 * v55
                    wave_x, wave_y = z, 0.0
                    bits, lane, begun = int((magnet.number + -1.0)), 93, False
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
                    v147 = wave_x
                    v148 = wave_y
                    A[k, 28], B[k, 28] = v56, v147
                    v149 = product(acc[28], A[0, 28], B[0, 28], later, v56, v147)
                    A[k, 29], B[k, 29] = v55, v148
                    v150 = product(acc[29], A[0, 29], B[0, 29], later, v55, v148)
                    v151 = c15 * v149 + c15 * v150
                    v152 = c17 * v134 + z
                    v153 = c18 * v139 + c19 * v151
                    A[k, 30], B[k, 30] = v55, v153
                    v154 = product(acc[30], A[0, 30], B[0, 30], later, v55, v153)
                    A[k, 31], B[k, 31] = v148, v152
                    v155 = product(acc[31], A[0, 31], B[0, 31], later, v148, v152)
                    v156 = c16 * v154 + c20 * v155
                    A[k, 32], B[k, 32] = v56, v153
                    v157 = product(acc[32], A[0, 32], B[0, 32], later, v56, v153)
                    A[k, 33], B[k, 33] = v147, v152
                    v158 = product(acc[33], A[0, 33], B[0, 33], later, v147, v152)
                    v159 = c16 * v157 + c20 * v158
                    v162 = v156
                    v163 = v159
                v165 = v162
                v166 = v163
            v168 = v165
            v169 = v166
            v171 = c21 * v58
            v172 = c22 * v59
        else:
            v168 = 0.0
            v169 = 0.0
            v171 = 0.0
            v172 = 0.0
        A[k, 34], B[k, 34] = v9, v9
        v173 = product(acc[34], A[0, 34], B[0, 34], later, v9, v9)
        v175 = Y[k, 30]
        v176 = Y[k, 36]
        v177 = Y[k, 37]
        A[k, 35], B[k, 35] = v9, v177
        v178 = product(acc[35], A[0, 35], B[0, 35], later, v9, v177)
        A[k, 36], B[k, 36] = v9, v176
        v179 = product(acc[36], A[0, 36], B[0, 36], later, v9, v176)
        D[k, 36] = v178
        D[k, 37] = -v179
        A[k, 37], B[k, 37] = v173, v177
        v182 = product(acc[37], A[0, 37], B[0, 37], later, v173, v177)
        A[k, 38], B[k, 38] = v173, v176
        v183 = product(acc[38], A[0, 38], B[0, 38], later, v173, v176)
        if levels.inner_house:
            v184 = v4 - v6
            v185 = c23 * v184 + c24 * z
            if north < 0.0:
                v186 = 0.0
            else:
                v186 = v185
            v187 = c25 * v184 + c24 * z
            if north > 0.0:
                v188 = 0.0
            else:
                v188 = v187
            v193 = v3 - v5
            v194 = v10 - v12
            v195 = c26 * v193 + c27 * v194
            v196 = v186 - v188
            v197 = v186
            v198 = v188
            v199 = v195
            v201 = v194
            v203 = c28 * v195
            v204 = c28 * v196
        else:
            v197 = c24 * z
            v198 = c24 * z
            v199 = 0.0
            v201 = 0.0
            v203 = 0.0
            v204 = 0.0
        if levels.outer_house:
            v205 = c29 * v5 + c24 * z
            if east < 0.0:
                v206 = 0.0
            else:
                v206 = v205
            v207 = c30 * v5 + c24 * z
            if east > 0.0:
                v208 = 0.0
            else:
                v208 = v207
            v213 = c31 * v6 + c32 * v13
            v214 = v206 - v208
            v215 = v199 - v214
            v216 = v197 - v198
            v217 = v216 - v213
            v218 = v206
            v219 = v208
            v220 = v213
            v222 = c33 * v215
            v223 = c33 * v217
        else:
            v218 = c24 * z
            v219 = c24 * z
            v220 = 0.0
            v222 = 0.0
            v223 = 0.0
        v224 = Y[k, 29]
        v225 = c34 * v224 + c35 * z
        v226 = v225 - v9
        v227 = v168 + v171
        v228 = c36 * v182 + c37 * v175
        v229 = c16 * v227 + c38 * v228
        v230 = v169 + v172
        v231 = c36 * v183 + c39 * v175
        v232 = c16 * v230 + c38 * v231
        v233 = v232 + c40 * z
        A[k, 39], B[k, 39] = v8, v53
        v243 = product(acc[39], A[0, 39], B[0, 39], later, v8, v53)
        A[k, 40], B[k, 40] = v7, v53
        v251 = product(acc[40], A[0, 40], B[0, 40], later, v7, v53)
        A[k, 41], B[k, 41] = v52, v251
        v252 = product(acc[41], A[0, 41], B[0, 41], later, v52, v251)
        v267 = 0.0
        A[k, 42], B[k, 42] = v77, v267
        v268 = product(acc[42], A[0, 42], B[0, 42], later, v77, v267)
        v269 = -v94 + v268
        A[k, 43], B[k, 43] = v76, v267
        v270 = product(acc[43], A[0, 43], B[0, 43], later, v76, v267)
        v271 = -v95 - v270
        v272 = v229 + c0 * v269
        v273 = v233 + c0 * v271
        if levels.euler:
            A[k, 44], B[k, 44] = v7, v8
            v274 = product(acc[44], A[0, 44], B[0, 44], later, v7, v8)
            A[k, 45], B[k, 45] = v7, v7
            v275 = product(acc[45], A[0, 45], B[0, 45], later, v7, v7)
            A[k, 46], B[k, 46] = v51, v275
            v276 = product(acc[46], A[0, 46], B[0, 46], later, v51, v275)
            A[k, 47], B[k, 47] = v52, v276
            v277 = product(acc[47], A[0, 47], B[0, 47], later, v52, v276)
            v278 = v274
            v279 = v277
        else:
            v278 = 0.0
            v279 = 0.0
        A[k, 48], B[k, 48] = v50, v273
        v280 = product(acc[48], A[0, 48], B[0, 48], later, v50, v273)
        v281 = -v280 + c41 * v243
        A[k, 49], B[k, 49] = v51, v278
        v282 = product(acc[49], A[0, 49], B[0, 49], later, v51, v278)
        v283 = c42 * v281 + 2.0 * v282
        i284 = 1.0 / v52 if k == 0 else i284
        v284 = quotient(acc[50], later * B[0, 50], v52, v283, i284)
        A[k, 50], B[k, 50] = v52, v284
        A[k, 51], B[k, 51] = v52, v272
        v285 = product(acc[51], A[0, 51], B[0, 51], later, v52, v272)
        A[k, 52], B[k, 52] = v54, v273
        v286 = product(acc[52], A[0, 52], B[0, 52], later, v54, v273)
        v287 = v285 + v286
        v288 = v287 + c43 * v252
        v289 = c42 * v288 - v279
        if levels.euler:
            A[k, 53], B[k, 53] = v51, v284
            v290 = product(acc[53], A[0, 53], B[0, 53], later, v51, v284)
            A[k, 54], B[k, 54] = v52, v278
            v291 = product(acc[54], A[0, 54], B[0, 54], later, v52, v278)
            v292 = v290 + v291
            v293 = v292
        else:
            v293 = 0.0
        if inputs.ideal_drive:
            v294 = v293 + c34 * z
            v295 = c43 * v294 + c5 * v267
            v297 = v294
            v298 = v295
        else:
            v296 = c44 * v226 + c45 * v267
            v297 = c46 * v296
            v298 = c44 * v226
        if levels.inner_house:
            v299 = v203 + c28 * v269
            v300 = v204 + c28 * v271
            v301 = v299
            v302 = v300
        else:
            v301 = v203
            v302 = v204
        v303 = v297 - v293
        if levels.outer_house:
            v318 = v218
            v319 = v219
            v320 = v220
        else:
            if levels.inner_house:
                v304 = v197 - v198
                v305 = 0.5 * v199 + c24 * z
                v306 = -0.5 * v199 + c24 * z
                v313 = v305
                v314 = v306
                v315 = v304
            else:
                v307 = -0.5 * v269 + c24 * z
                v308 = 0.5 * v269 + c24 * z
                v313 = v307
                v314 = v308
                v315 = -v271
            v318 = v313
            v319 = v314
            v320 = v315
        v321 = v298 + c45 * v267
        A[k, 55], B[k, 55] = v53, v298
        v322 = product(acc[55], A[0, 55], B[0, 55], later, v53, v298)
        A[k, 56], B[k, 56] = v58, v175
        v323 = product(acc[56], A[0, 56], B[0, 56], later, v58, v175)
        A[k, 57], B[k, 57] = v59, v175
        v324 = product(acc[57], A[0, 57], B[0, 57], later, v59, v175)
        v325 = c37 * v323 + c39 * v324
        A[k, 58], B[k, 58] = v58, v182
        v326 = product(acc[58], A[0, 58], B[0, 58], later, v58, v182)
        A[k, 59], B[k, 59] = v59, v183
        v327 = product(acc[59], A[0, 59], B[0, 59], later, v59, v183)
        v328 = c36 * v326 + c36 * v327
        A[k, 60], B[k, 60] = v12, v269
        v329 = product(acc[60], A[0, 60], B[0, 60], later, v12, v269)
        A[k, 61], B[k, 61] = v13, v271
        v330 = product(acc[61], A[0, 61], B[0, 61], later, v13, v271)
        v331 = v329 + v330
        A[k, 62], B[k, 62] = v58, v171
        v332 = product(acc[62], A[0, 62], B[0, 62], later, v58, v171)
        A[k, 63], B[k, 63] = v59, v172
        v333 = product(acc[63], A[0, 63], B[0, 63], later, v59, v172)
        v334 = v332 + v333
        A[k, 64], B[k, 64] = v201, v201
        v335 = product(acc[64], A[0, 64], B[0, 64], later, v201, v201)
        A[k, 65], B[k, 65] = v13, v13
        v336 = product(acc[65], A[0, 65], B[0, 65], later, v13, v13)
        v337 = c27 * v335 + c32 * v336
        v338 = v93 - v89
        A[k, 66], B[k, 66] = v80, v338
        v339 = product(acc[66], A[0, 66], B[0, 66], later, v80, v338)
        A[k, 67], B[k, 67] = v84, v267
        v340 = product(acc[67], A[0, 67], B[0, 67], later, v84, v267)
        A[k, 68], B[k, 68] = v57, v273
        v341 = product(acc[68], A[0, 68], B[0, 68], later, v57, v273)
        A[k, 69], B[k, 69] = v55, v321
        v342 = product(acc[69], A[0, 69], B[0, 69], later, v55, v321)
        v343 = -v341 + v342
        A[k, 70], B[k, 70] = v57, v272
        v344 = product(acc[70], A[0, 70], B[0, 70], later, v57, v272)
        A[k, 71], B[k, 71] = v56, v321
        v345 = product(acc[71], A[0, 71], B[0, 71], later, v56, v321)
        v346 = v344 + v345
        A[k, 72], B[k, 72] = v55, v273
        v347 = product(acc[72], A[0, 72], B[0, 72], later, v55, v273)
        A[k, 73], B[k, 73] = v56, v272
        v348 = product(acc[73], A[0, 73], B[0, 73], later, v56, v272)
        v349 = v347 - v348
        A[k, 74], B[k, 74] = v57, v321
        v350 = product(acc[74], A[0, 74], B[0, 74], later, v57, v321)
        v351 = v349 + v350
        v352 = v318 - v319
        v353 = -v269 - v352
        v354 = -v271 - v320
        if levels.euler:
            A[k, 75], B[k, 75] = v7, v7
            v355 = product(acc[75], A[0, 75], B[0, 75], later, v7, v7)
            A[k, 76], B[k, 76] = v8, v8
            v356 = product(acc[76], A[0, 76], B[0, 76], later, v8, v8)
            v357 = v355 + v356
            A[k, 77], B[k, 77] = v7, v8
            v358 = product(acc[77], A[0, 77], B[0, 77], later, v7, v8)
            A[k, 78], B[k, 78] = v52, v289
            v359 = product(acc[78], A[0, 78], B[0, 78], later, v52, v289)
            A[k, 79], B[k, 79] = v8, v51
            v360 = product(acc[79], A[0, 79], B[0, 79], later, v8, v51)
            A[k, 80], B[k, 80] = v8, v360
            v361 = product(acc[80], A[0, 80], B[0, 80], later, v8, v360)
            v362 = v359 - v361
            A[k, 81], B[k, 81] = v50, v52
            v363 = product(acc[81], A[0, 81], B[0, 81], later, v50, v52)
            A[k, 82], B[k, 82] = v284, v363
            v364 = product(acc[82], A[0, 82], B[0, 82], later, v284, v363)
            A[k, 83], B[k, 83] = v49, v51
            v365 = product(acc[83], A[0, 83], B[0, 83], later, v49, v51)
            A[k, 84], B[k, 84] = v289, v365
            v366 = product(acc[84], A[0, 84], B[0, 84], later, v289, v365)
            v367 = -v364 + v366
            A[k, 85], B[k, 85] = v49, v52
            v368 = product(acc[85], A[0, 85], B[0, 85], later, v49, v52)
            A[k, 86], B[k, 86] = v357, v368
            v369 = product(acc[86], A[0, 86], B[0, 86], later, v357, v368)
            v370 = v367 + v369
            A[k, 87], B[k, 87] = v50, v51
            v371 = product(acc[87], A[0, 87], B[0, 87], later, v50, v51)
            A[k, 88], B[k, 88] = v358, v371
            v372 = product(acc[88], A[0, 88], B[0, 88], later, v358, v371)
            v373 = v370 + 2.0 * v372
            v381 = v362
            v382 = v373
        else:
            v381 = v289
            v382 = -v284
        v384 = c0 * v381 - v301
        v385 = v384 + c1 * v222
        v386 = c0 * v382 - v302
        v387 = v386 + c1 * v223
        A[k, 89], B[k, 89] = v76, v387
        v388 = product(acc[89], A[0, 89], B[0, 89], later, v76, v387)
        A[k, 90], B[k, 90] = v77, v385
        v389 = product(acc[90], A[0, 90], B[0, 90], later, v77, v385)
        v390 = v388 - v389
        A[k, 91], B[k, 91] = v80, v83
        v391 = product(acc[91], A[0, 91], B[0, 91], later, v80, v83)
        i392 = 1.0 / v73 if k == 0 else i392
        v392 = quotient(acc[92], later * B[0, 92], v73, v391, i392)
        A[k, 92], B[k, 92] = v73, v392
        v393 = v390 - v392
        v394 = v393 + c5 * v297
        v395 = Y[k, 31]
        friction = v394 * per_friction
        v267 = friction
        A[k, 42], B[k, 42] = v77, v267
        v268 = product(acc[42], A[0, 42], B[0, 42], later, v77, v267)
        v269 = -v94 + v268
        A[k, 43], B[k, 43] = v76, v267
        v270 = product(acc[43], A[0, 43], B[0, 43], later, v76, v267)
        v271 = -v95 - v270
        v272 = v229 + c0 * v269
        v273 = v233 + c0 * v271
        A[k, 48], B[k, 48] = v50, v273
        v280 = product(acc[48], A[0, 48], B[0, 48], later, v50, v273)
        v281 = -v280 + c41 * v243
        v283 = c42 * v281 + 2.0 * v282
        i284 = 1.0 / v52 if k == 0 else i284
        v284 = quotient(acc[50], later * B[0, 50], v52, v283, i284)
        A[k, 50], B[k, 50] = v52, v284
        A[k, 51], B[k, 51] = v52, v272
        v285 = product(acc[51], A[0, 51], B[0, 51], later, v52, v272)
        A[k, 52], B[k, 52] = v54, v273
        v286 = product(acc[52], A[0, 52], B[0, 52], later, v54, v273)
        v287 = v285 + v286
        v288 = v287 + c43 * v252
        v289 = c42 * v288 - v279
        if levels.euler:
            A[k, 53], B[k, 53] = v51, v284
            v290 = product(acc[53], A[0, 53], B[0, 53], later, v51, v284)
            v292 = v290 + v291
            v293 = v292
        else:
            v293 = 0.0
        if inputs.ideal_drive:
            v294 = v293 + c34 * z
            v295 = c43 * v294 + c5 * v267
            v297 = v294
            v298 = v295
        else:
            v296 = c44 * v226 + c45 * v267
            v297 = c46 * v296
            v298 = c44 * v226
        if levels.inner_house:
            v299 = v203 + c28 * v269
            v300 = v204 + c28 * v271
            v301 = v299
            v302 = v300
        else:
            v301 = v203
            v302 = v204
        v303 = v297 - v293
        if levels.outer_house:
            v318 = v218
            v319 = v219
            v320 = v220
        else:
            if levels.inner_house:
                v313 = v305
                v314 = v306
                v315 = v304
            else:
                v307 = -0.5 * v269 + c24 * z
                v308 = 0.5 * v269 + c24 * z
                v313 = v307
                v314 = v308
                v315 = -v271
            v318 = v313
            v319 = v314
            v320 = v315
        v321 = v298 + c45 * v267
        A[k, 55], B[k, 55] = v53, v298
        v322 = product(acc[55], A[0, 55], B[0, 55], later, v53, v298)
        A[k, 60], B[k, 60] = v12, v269
        v329 = product(acc[60], A[0, 60], B[0, 60], later, v12, v269)
        A[k, 61], B[k, 61] = v13, v271
        v330 = product(acc[61], A[0, 61], B[0, 61], later, v13, v271)
        v331 = v329 + v330
        A[k, 67], B[k, 67] = v84, v267
        v340 = product(acc[67], A[0, 67], B[0, 67], later, v84, v267)
        A[k, 68], B[k, 68] = v57, v273
        v341 = product(acc[68], A[0, 68], B[0, 68], later, v57, v273)
        A[k, 69], B[k, 69] = v55, v321
        v342 = product(acc[69], A[0, 69], B[0, 69], later, v55, v321)
        v343 = -v341 + v342
        A[k, 70], B[k, 70] = v57, v272
        v344 = product(acc[70], A[0, 70], B[0, 70], later, v57, v272)
        A[k, 71], B[k, 71] = v56, v321
        v345 = product(acc[71], A[0, 71], B[0, 71], later, v56, v321)
        v346 = v344 + v345
        A[k, 72], B[k, 72] = v55, v273
        v347 = product(acc[72], A[0, 72], B[0, 72], later, v55, v273)
        A[k, 73], B[k, 73] = v56, v272
        v348 = product(acc[73], A[0, 73], B[0, 73], later, v56, v272)
        v349 = v347 - v348
        A[k, 74], B[k, 74] = v57, v321
        v350 = product(acc[74], A[0, 74], B[0, 74], later, v57, v321)
        v351 = v349 + v350
        v352 = v318 - v319
        v353 = -v269 - v352
        v354 = -v271 - v320
        if levels.euler:
            A[k, 78], B[k, 78] = v52, v289
            v359 = product(acc[78], A[0, 78], B[0, 78], later, v52, v289)
            v362 = v359 - v361
            A[k, 82], B[k, 82] = v284, v363
            v364 = product(acc[82], A[0, 82], B[0, 82], later, v284, v363)
            A[k, 84], B[k, 84] = v289, v365
            v366 = product(acc[84], A[0, 84], B[0, 84], later, v289, v365)
            v367 = -v364 + v366
            v370 = v367 + v369
            v373 = v370 + 2.0 * v372
            v381 = v362
            v382 = v373
        else:
            v381 = v289
            v382 = -v284
        v384 = c0 * v381 - v301
        v385 = v384 + c1 * v222
        v386 = c0 * v382 - v302
        v387 = v386 + c1 * v223
        A[k, 89], B[k, 89] = v76, v387
        v388 = product(acc[89], A[0, 89], B[0, 89], later, v76, v387)
        A[k, 90], B[k, 90] = v77, v385
        v389 = product(acc[90], A[0, 90], B[0, 90], later, v77, v385)
        v390 = v388 - v389
        v393 = v390 - v392
        v394 = v393 + c5 * v297
        D[k, 0] = v7
        D[k, 1] = v8
        D[k, 2] = v9
        D[k, 3] = v10
        D[k, 4] = v11
        D[k, 5] = v12
        D[k, 6] = v13
        D[k, 7] = v284
        D[k, 8] = v289
        D[k, 9] = v303
        D[k, 10] = v301
        D[k, 11] = v302
        D[k, 12] = v222
        D[k, 13] = v223
        D[k, 14] = v322
        D[k, 15] = c38 * v325
        D[k, 16] = c38 * v328
        D[k, 17] = c47 * v331
        D[k, 18] = 0.0
        D[k, 19] = c15 * v334
        D[k, 20] = v337
        D[k, 21] = v339
        D[k, 22] = v340
        D[k, 23] = v93
        D[k, 24] = v343
        D[k, 25] = v346
        D[k, 26] = v351
        D[k, 27] = v353
        D[k, 28] = v354
        D[k, 29] = z
        D[k, 30] = c48 * v395
        D[k, 31] = c49 * v175
        Y[k, 39] = v93
        Y[k, 40] = v74
        Y[k, 41] = v267
        Y[k, 42] = 0.0
        portion = 1.0 / (k + 1.0)
        for i in range(38):
            Y[k + 1, i] = D[k, i] * portion
        Y[k + 1, 38] = 0.0
        z, later = 0.0, 1.0
    for i in range(39, 43):
        Y[ORDER, i] = 0.0
