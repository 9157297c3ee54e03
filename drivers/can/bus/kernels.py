"""Compiled part of the bus, in one long file because numba's cache checks only the file of the kernel that it loads.

A kernel that calls a kernel of another file could be loaded in an outdated version. In order: bits of frames,
arbitration, queues, faults, error counters. The imports from `drivers.can.bus.frame` are constants of the standard.
Bits follow ISO 11898-1:2015, 10.4 and 10.5 (classic and FD, base and extended format). Levels: 0 dominant, 1 recessive.
Time is an integer [ns]; bit times are integers [ps].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from drivers.can.bus.frame import BRS, ESI, EXTENDED, FD, FD_LENGTHS, FD_WIDTH, INTERMISSION, REMOTE

# Kinds of an encoded bit, added.
FAST = 1
STUFF = 2
FIXED = 4

MAX_BITS = 800
"""Upper limit for the bits of a stuffed frame (the longest has fewer than 740)."""

TAIL = 10
"""CRC delimiter 1, ACK 1, ACK delimiter 1, end of frame 7."""

# Columns of `Bus.nodes`.
ATTACHED, LISTENING, CAPACITY = 0, 1, 2
TEC, REC, STATE, COUNT, HEAD, SUSPENDED, LEFT, RECOVERING, QUIET = 3, 4, 5, 6, 7, 8, 9, 10, 11
DISTURBED, DISTURBED_BIT = 12, 13
SENT, ERRORS, DROPPED, REFUSED, BUS_OFFS = 14, 15, 16, 17, 18
IN_ORDER = 19
NODE_COLUMNS = 20

ACTIVE, PASSIVE, OFF = 0, 1, 2

# Columns of `Bus.slots`.
KEY, AT, SEQUENCE, NOMINAL, QUICK, DURATION, ATTEMPTS, OWNER = 0, 1, 2, 3, 4, 5, 6, 7
SLOT_COLUMNS = 8

# Cells of `Bus.cells`.
NOW, FREE, SENDERS, START, END, OUTCOME, NEXT, ARRIVALS = 0, 1, 2, 3, 4, 5, 6, 7
BUSY, FRAMES, WINDOW, WINDOW_BUSY, WINDOW_LAST = 8, 9, 10, 11, 12
GAP, MORE, SEQUENCES, FREE_SLOTS, WINDOW_LENGTH = 13, 14, 15, 16, 17
CELLS = 18

# Outcomes of a frame.
OUTCOMES = (
    "",
    "bit error",
    "no acknowledge",
    "collision of equal identifiers",
    "queue full",
    "bus-off",
    "detached",
)
GOOD, BIT_ERROR, NO_ACKNOWLEDGE, COLLISION, QUEUE_FULL, BUS_OFF, DETACHED = range(7)

# Columns of a result.
R_SLOT, R_START, R_END, R_OUTCOME, R_ATTEMPT, R_NODE, R_AT, R_FINAL = 0, 1, 2, 3, 4, 5, 6, 7
RESULT_COLUMNS = 8

_INFINITE = np.int64(1) << 62
_RECESSIVE_RUN = 11
_RECOVERY = 128


class Bus(NamedTuple):
    """State of a bus, in arrays that the kernels change.

    Attributes:
        cells: Scalars, shape (CELLS,).
        nodes: One row per node, shape (nodes, NODE_COLUMNS).
        queues: Slots in each node's queue, unordered, shape (nodes, capacity).
        slots: One row per frame that is queued or will be, shape (slots, SLOT_COLUMNS).
        store: Frames of the slots, records of `drivers.can.bus.frame.RECORD`, shape (slots,).
        arrivals: Slots that are not queued yet, by time, shape (slots,).
        unused: Stack of free slots, shape (slots,).
        senders: Slots on the wire; more than one only if nodes send the same identifier, shape (nodes,).
        random: State of the generator of bit errors, shape (1,).
    """

    cells: np.ndarray
    nodes: np.ndarray
    queues: np.ndarray
    slots: np.ndarray
    store: np.ndarray
    arrivals: np.ndarray
    unused: np.ndarray
    senders: np.ndarray
    random: np.ndarray


_CODES = np.zeros(FD_WIDTH + 1, np.int64)
_CODES[list(FD_LENGTHS)] = range(len(FD_LENGTHS))
"""Data length code by number of bytes."""


@njit(cache=True, error_model="numpy")
def _write(raw, n, value, width):
    """Append a number to bits, the highest bit first; return the new number of bits."""
    for k in range(width - 1, -1, -1):
        raw[n] = (value >> k) & 1
        n += 1
    return n


@njit(cache=True, error_model="numpy")
def header_and_data(identifier, length, flags, data, raw):
    """Write the unstuffed bits from start of frame to the end of the data field.

    Returns:
        Their number, and the index of the first bit that is sent at the data rate (MAX_BITS without one).
    """
    fd = (flags & FD) != 0
    extended = (identifier & EXTENDED) != 0
    remote = 1 if (identifier & REMOTE) != 0 and not fd else 0
    raw[0] = 0
    if extended:
        n = _write(raw, 1, identifier >> 18, 11)
        n = _write(raw, n, 3, 2)  # SRR, IDE
        n = _write(raw, n, identifier, 18)
        n = _write(raw, n, remote, 1)  # RRS or RTR
    else:
        n = _write(raw, 1, identifier, 11)
        n = _write(raw, n, remote << 1, 2)  # RRS or RTR, IDE
    switch = MAX_BITS
    if fd:
        n = _write(raw, n, 2, 2)  # FDF, res
        n = _write(raw, n, 1 if (flags & BRS) != 0 else 0, 1)
        if (flags & BRS) != 0:
            switch = n
        n = _write(raw, n, 1 if (flags & ESI) != 0 else 0, 1)
    else:
        n = _write(raw, n, 0, 2 if extended else 1)  # FDF, in extended frames r0
    n = _write(raw, n, _CODES[length], 4)
    if remote == 0:
        for i in range(length):
            n = _write(raw, n, data[i], 8)
    return n, switch


@njit(cache=True, error_model="numpy")
def _crc(bits, n, crc, width, polynomial):
    """Return the CRC register after n more bits (ISO 11898-1:2015, 10.4.2.6)."""
    mask = (1 << width) - 1
    for i in range(n):
        feed = bits[i] ^ (crc >> (width - 1))
        crc = (crc << 1) & mask
        if feed:
            crc ^= polynomial
    return crc


@njit(cache=True, error_model="numpy")
def _write_stuffed(identifier, length, flags, data, work):
    """Write the bits up to the end of content stuffing: of a classic frame the CRC, of an FD frame the data.

    Args:
        identifier: Identifier with its flags.
        length: Bytes of data, or requested by a remote frame.
        flags: FD, BRS, ESI.
        data: Bytes, at least `length`.
        work: Out: levels, kinds, and work space, uint8, shape (3, MAX_BITS).

    Returns:
        Number of bits, number of bits at the nominal rate, number of stuff bits, and the CRC of a classic frame.
    """
    bits, kinds, raw = work[0], work[1], work[2]
    n, switch = header_and_data(identifier, length, flags, data, raw)
    crc = 0
    # After the last bit of an FD frame's data a fixed stuff bit replaces one by content.
    stop = n - 1
    if (flags & FD) == 0:
        crc = _crc(raw, n, 0, 15, 0x4599)
        n = _write(raw, n, crc, 15)
        stop = n
    out = 0
    slow = 0
    last = 1
    run = 1
    for i in range(n):
        fast = FAST if i >= switch else 0
        bits[out] = raw[i]
        kinds[out] = fast
        out += 1
        slow += fast == 0
        run = run + 1 if raw[i] == last else 1
        last = raw[i]
        if run == 5 and i < stop:
            last ^= 1
            run = 1
            fast = FAST if i >= switch - 1 else 0
            bits[out] = last
            kinds[out] = STUFF + fast
            out += 1
            slow += fast == 0
    return out, slow, out - n, crc


@njit(cache=True, error_model="numpy")
def count_bits(identifier, length, flags, data, work):
    """Count the bits of a frame with stuffing and intermission: at the nominal rate and at the data rate.

    The bit BRS and the CRC delimiter are each sent partly at one rate and partly at the other, divided at the sample
    points; together they last exactly one nominal and one data bit time, and are counted so. Arguments as for
    `_write_stuffed`.
    """
    count, slow, _, _ = _write_stuffed(identifier, length, flags, data, work)
    if (flags & FD) == 0:
        return slow + TAIL + INTERMISSION, 0
    # Stuff count and parity 4, CRC 17 or 21, fixed stuff bits: one before, one after each fourth bit.
    tail = 4 + 17 + 6 if length <= 16 else 4 + 21 + 7
    if (flags & BRS) != 0:
        return slow + TAIL - 1 + INTERMISSION, count - slow + tail + 1
    return slow + tail + TAIL + INTERMISSION, 0


@njit(cache=True, error_model="numpy")
def encode(record, work):
    """Write all bits of an acknowledged frame on the wire, with the intermission.

    Args:
        record: The frame, of `drivers.can.bus.frame.RECORD`.
        work: Out: levels; kinds FAST, STUFF, FIXED added; work space; uint8, shape (3, MAX_BITS).

    Returns:
        Number of bits, and the CRC.
    """
    bits, kinds, raw = work[0], work[1], work[2]
    length, flags = np.int64(record["length"]), np.int64(record["flags"])
    out, _, stuffed, crc = _write_stuffed(np.int64(record["identifier"]), length, flags, record["data"], work)
    fd = (flags & FD) != 0
    kind = FAST if (flags & BRS) != 0 and fd else 0
    if fd:
        width = 17 if length <= 16 else 21
        polynomial = 0x1685B if length <= 16 else 0x102899
        gray = (stuffed % 8) ^ ((stuffed % 8) >> 1)
        parity = (gray ^ (gray >> 1) ^ (gray >> 2)) & 1
        n = _write(raw, 0, (gray << 1) | parity, 4)
        # The CRC covers dynamic stuff bits and the stuff count, not the fixed stuff bits; it starts at 1, 0, 0, ...
        crc = _crc(raw, n, _crc(bits, out, 1 << (width - 1), width, polynomial), width, polynomial)
        n = _write(raw, n, crc, width)
        for i in range(n):
            if i % 4 == 0:
                bits[out] = 1 - bits[out - 1]
                kinds[out] = FIXED + kind
                out += 1
            bits[out] = raw[i]
            kinds[out] = kind
            out += 1
    bits[out : out + TAIL + INTERMISSION] = 1
    bits[out + 1] = 0  # ACK, after the CRC delimiter
    kinds[out] = kind
    kinds[out + 1 : out + TAIL + INTERMISSION] = 0
    return out + TAIL + INTERMISSION, crc


@njit(cache=True, error_model="numpy")
def priority(identifier, flags):
    """Return the arbitration field as a number; the lower wins the bus.

    Base identifier, RTR or SRR, IDE, extension, RTR, in the order on the wire; bits that a base frame lacks are 0,
    because it has won already at IDE.
    """
    remote = 1 if (identifier & REMOTE) != 0 and (flags & FD) == 0 else 0
    if (identifier & EXTENDED) != 0:
        value = identifier & 0x1FFFFFFF
        return ((value >> 18) << 21) | (1 << 20) | (1 << 19) | ((value & 0x3FFFF) << 1) | remote
    return ((identifier & 0x7FF) << 21) | (remote << 20)


@njit(cache=True, error_model="numpy")
def enlist(bus, batch, count, nominal_ps, data_ps):
    """Put `count` frames of a batch of records into free slots and the list of arrivals.

    Frames with a time in the past are offered now. Equal times keep the order of offering. There must be room.
    """
    cells, slots, store, arrivals, unused = bus.cells, bus.slots, bus.store, bus.arrivals, bus.unused
    work = np.empty((3, MAX_BITS), np.uint8)
    waiting = cells[ARRIVALS] - cells[NEXT]
    if cells[NEXT] > 0:
        for k in range(waiting):
            arrivals[k] = arrivals[cells[NEXT] + k]
        cells[NEXT] = 0
        cells[ARRIVALS] = waiting
    for i in range(count):
        cells[FREE_SLOTS] -= 1
        s = unused[cells[FREE_SLOTS]]
        store[s] = batch[i]
        record = store[s]
        identifier = np.int64(record["identifier"])
        flags = np.int64(record["flags"])
        nominal, quick = count_bits(identifier, np.int64(record["length"]), flags, record["data"], work)
        at = max(np.int64(record["time_ns"]), cells[NOW])
        slots[s, KEY] = priority(identifier, flags)
        slots[s, AT] = at
        slots[s, NOMINAL] = nominal
        slots[s, QUICK] = quick
        slots[s, DURATION] = ((nominal - INTERMISSION) * nominal_ps + quick * data_ps + 500) // 1000
        slots[s, ATTEMPTS] = 0
        slots[s, OWNER] = record["node"]
        k = cells[ARRIVALS]
        while k > 0 and slots[arrivals[k - 1], AT] > at:
            arrivals[k] = arrivals[k - 1]
            k -= 1
        arrivals[k] = s
        cells[ARRIVALS] += 1


@njit(cache=True, error_model="numpy")
def _draw_gap(random, chance):
    """Draw the number of good bits before a bad one: geometric, by inversion; splitmix64 (Steele, Lea, Flood 2014)."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    uniform = (np.float64(z >> np.uint64(11)) + 1.0) / 9007199254740993.0
    if chance >= 1.0:
        return np.int64(0)
    return np.int64(min(np.log(uniform) / np.log1p(-chance), 4.0e18))


@njit(cache=True, error_model="numpy")
def draw_gap(bus, chance):
    """Draw the distance to the next bit error; it is beyond any run if the error rate is zero."""
    bus.cells[GAP] = _draw_gap(bus.random, chance) if chance > 0.0 else _INFINITE


@njit(cache=True, error_model="numpy")
def _store_result(out, count, slot, start, end, outcome, slots, final):
    out[count, R_SLOT] = slot
    out[count, R_START] = start
    out[count, R_END] = end
    out[count, R_OUTCOME] = outcome
    out[count, R_ATTEMPT] = slots[slot, ATTEMPTS]
    out[count, R_NODE] = slots[slot, OWNER]
    out[count, R_AT] = slots[slot, AT]
    out[count, R_FINAL] = final
    return count + 1


@njit(cache=True, error_model="numpy")
def _find_head(bus, node):
    """Find the frame that the node sends next: by priority, unless it keeps the order; equal ones keep theirs."""
    head = np.int64(-1)
    for k in range(bus.nodes[node, COUNT]):
        s = bus.queues[node, k]
        if head < 0:
            head = s
            continue
        key, best = (0, 0) if bus.nodes[node, IN_ORDER] else (bus.slots[s, KEY], bus.slots[head, KEY])
        if key < best or (key == best and bus.slots[s, SEQUENCE] < bus.slots[head, SEQUENCE]):
            head = s
    bus.nodes[node, HEAD] = head


@njit(cache=True, error_model="numpy")
def _remove(bus, node, slot):
    for k in range(bus.nodes[node, COUNT]):
        if bus.queues[node, k] == slot:
            bus.nodes[node, COUNT] -= 1
            bus.queues[node, k] = bus.queues[node, bus.nodes[node, COUNT]]
            break
    _find_head(bus, node)


@njit(cache=True, error_model="numpy")
def _rejoin(bus, t, run_ns):
    """Release nodes from bus-off whose 128 runs of 11 recessive bits were complete by t."""
    nodes = bus.nodes
    for n in range(nodes.shape[0]):
        if nodes[n, RECOVERING] != 0 and nodes[n, QUIET] + nodes[n, LEFT] * run_ns <= t:
            nodes[n, RECOVERING] = 0
            nodes[n, STATE] = ACTIVE
            nodes[n, TEC] = 0
            nodes[n, REC] = 0


@njit(cache=True, error_model="numpy")
def _admit(bus, out, count):
    """Put the next arrival into its node's queue; it is dropped if the queue is full."""
    cells, nodes = bus.cells, bus.nodes
    s = bus.arrivals[cells[NEXT]]
    cells[NEXT] += 1
    n = bus.slots[s, OWNER]
    at = bus.slots[s, AT]
    if nodes[n, ATTACHED] == 0:
        return _store_result(out, count, s, at, at, DETACHED, bus.slots, 1)
    if nodes[n, STATE] == OFF:
        nodes[n, REFUSED] += 1
        return _store_result(out, count, s, at, at, BUS_OFF, bus.slots, 1)
    if nodes[n, COUNT] >= nodes[n, CAPACITY]:
        nodes[n, DROPPED] += 1
        return _store_result(out, count, s, at, at, QUEUE_FULL, bus.slots, 1)
    bus.slots[s, SEQUENCE] = cells[SEQUENCES]
    cells[SEQUENCES] += 1
    bus.queues[n, nodes[n, COUNT]] = s
    nodes[n, COUNT] += 1
    head = nodes[n, HEAD]
    if head < 0 or (nodes[n, IN_ORDER] == 0 and bus.slots[s, KEY] < bus.slots[head, KEY]):
        nodes[n, HEAD] = s
    return count


@njit(cache=True, error_model="numpy")
def _find_error_end(bus, position, nominal_ps, data_ps, receivers_active, receivers):
    """Return the duration of an error that the sender sees in the bit at `position` of the frame on the wire.

    The sender's flag starts with the next bit. Receivers detect it after six equal bits and send their own flags:
    superposed they last 6 to 12 bits (ISO 11898-1:2015, 10.4.4). In a field of fixed form, or where the bad bit itself
    completes six equal ones, all nodes detect it at once. Then 8 bits of delimiter follow.

    Returns:
        Time from the start of frame to the end of the delimiter [ns].
    """
    work = np.empty((3, MAX_BITS), np.uint8)
    bits, kinds = work[0], work[1]
    total, _ = encode(bus.store[bus.senders[0]], work)
    time_ps = np.int64(0)
    for k in range(position + 1):
        time_ps += data_ps if (kinds[k] & FAST) != 0 else nominal_ps
    passive = True
    for k in range(bus.cells[SENDERS]):
        if bus.nodes[bus.slots[bus.senders[k], OWNER], STATE] == ACTIVE:
            passive = False
    flag = 6
    fixed = position >= total - INTERMISSION - TAIL or (kinds[position] & FIXED) != 0
    if receivers and receivers_active and not fixed:
        level = 1 - bits[position]
        run = 1
        k = position - 1
        while k >= 0 and bits[k] == level:
            run += 1
            k -= 1
        if run < 6:
            flag = 12 - (run if level == (1 if passive else 0) else 0)
    elif receivers_active and position == total - INTERMISSION - 9:
        flag = 7  # The acknowledge is missing: receivers see it from the flag's first bit, in the delimiter.
    return (time_ps + (flag + 8) * nominal_ps + 500) // 1000


@njit(cache=True, error_model="numpy")
def _find_difference(bus):
    """Return the first bit in which the frames on the wire differ; -1 if they are equal."""
    work = np.empty((3, MAX_BITS), np.uint8)
    other = np.empty((3, MAX_BITS), np.uint8)
    n, _ = encode(bus.store[bus.senders[0]], work)
    first = np.int64(-1)
    for k in range(1, bus.cells[SENDERS]):
        m, _ = encode(bus.store[bus.senders[k]], other)
        for i in range(min(n, m)):
            if work[0, i] != other[0, i]:
                if first < 0 or i < first:
                    first = i
                break
    return first


@njit(cache=True, error_model="numpy")
def _start_transmission(bus, start, nominal_ps, data_ps, chance):
    """Start a transmission: arbitrate, put the winner on the wire, and determine when and how it ends."""
    cells, nodes, slots = bus.cells, bus.nodes, bus.slots
    best = _INFINITE
    for n in range(nodes.shape[0]):
        if nodes[n, COUNT] > 0 and nodes[n, SUSPENDED] <= start:
            best = min(best, slots[nodes[n, HEAD], KEY])
    cells[SENDERS] = 0
    for n in range(nodes.shape[0]):
        if nodes[n, COUNT] > 0 and nodes[n, SUSPENDED] <= start:
            s = nodes[n, HEAD]
            if slots[s, KEY] == best:
                bus.senders[cells[SENDERS]] = s
                cells[SENDERS] += 1
                slots[s, ATTEMPTS] += 1
    receivers = False
    receivers_active = False
    for n in range(nodes.shape[0]):
        if nodes[n, ATTACHED] != 0 and nodes[n, STATE] != OFF and nodes[n, LISTENING] == 0:
            sends = False
            for k in range(cells[SENDERS]):
                if slots[bus.senders[k], OWNER] == n:
                    sends = True
            if not sends:
                receivers = True
                if nodes[n, STATE] == ACTIVE:
                    receivers_active = True
    s = bus.senders[0]
    total = slots[s, NOMINAL] + slots[s, QUICK] - INTERMISSION
    position = np.int64(-1)
    outcome = GOOD
    if cells[SENDERS] > 1:
        position = _find_difference(bus)
        outcome = COLLISION
    if position < 0:
        outcome = BIT_ERROR
        for k in range(cells[SENDERS]):
            n = slots[bus.senders[k], OWNER]
            if nodes[n, DISTURBED] > 0:
                nodes[n, DISTURBED] -= 1
                position = min(nodes[n, DISTURBED_BIT], total - 1)
    if chance > 0.0 and position < 0:
        if cells[GAP] < total:
            position = cells[GAP]
            cells[GAP] = _draw_gap(bus.random, chance)
        else:
            cells[GAP] -= total
    if position < 0 and not receivers and cells[SENDERS] == 1:
        outcome = NO_ACKNOWLEDGE
        position = total - 9
    cells[START] = start
    if position < 0:
        cells[OUTCOME] = GOOD
        cells[END] = start + slots[s, DURATION]
    else:
        cells[OUTCOME] = outcome
        cells[END] = start + _find_error_end(bus, position, nominal_ps, data_ps, receivers_active, receivers)


@njit(cache=True, error_model="numpy")
def _update_state(bus, n):
    """Update a node's state from its counters; return whether it is newly bus-off (ISO 11898-1:2015, 12.1.4.2 ff.)."""
    nodes = bus.nodes
    if nodes[n, STATE] == OFF:
        return False
    if nodes[n, TEC] > 255:
        nodes[n, STATE] = OFF
        nodes[n, BUS_OFFS] += 1
        return True
    nodes[n, STATE] = PASSIVE if nodes[n, TEC] > 127 or nodes[n, REC] > 127 else ACTIVE
    return False


@njit(cache=True, error_model="numpy")
def close_windows(cells, t):
    """Close every window of the load that ended by t."""
    length = cells[WINDOW_LENGTH]
    if t >= cells[WINDOW] + length:
        cells[WINDOW_LAST] = cells[WINDOW_BUSY]
        cells[WINDOW_BUSY] = 0
        cells[WINDOW] += length
        if t >= cells[WINDOW] + length:
            cells[WINDOW_LAST] = 0
            cells[WINDOW] += (t - cells[WINDOW]) // length * length


@njit(cache=True, error_model="numpy")
def _occupy(cells, start, end):
    """Count the bus as occupied from start to end, divided among the windows."""
    cells[BUSY] += end - start
    close_windows(cells, start)
    while end > cells[WINDOW] + cells[WINDOW_LENGTH]:
        edge = cells[WINDOW] + cells[WINDOW_LENGTH]
        cells[WINDOW_BUSY] += edge - start
        start = edge
        close_windows(cells, start)
    cells[WINDOW_BUSY] += end - start


@njit(cache=True, error_model="numpy")
def _complete(bus, out, count, nominal_ps):
    """Complete the transmission on the wire: counters, states, queues, results."""
    cells, nodes, slots = bus.cells, bus.nodes, bus.slots
    start, end, outcome = cells[START], cells[END], cells[OUTCOME]
    cells[FREE] = end + (INTERMISSION * nominal_ps + 500) // 1000
    run_ns = (_RECESSIVE_RUN * nominal_ps + 500) // 1000
    _occupy(cells, start, cells[FREE])
    good = outcome == GOOD
    cells[FRAMES] += good
    for n in range(nodes.shape[0]):
        if nodes[n, ATTACHED] == 0:
            continue
        if nodes[n, RECOVERING] != 0:
            # Acknowledge delimiter, end of frame and intermission are 11 recessive bits, as is the end of an error.
            nodes[n, LEFT] -= max(np.int64(0), start - nodes[n, QUIET]) // run_ns + 1
            nodes[n, QUIET] = cells[FREE]
        if nodes[n, STATE] == OFF or nodes[n, LISTENING] != 0:
            continue
        sends = False
        for k in range(cells[SENDERS]):
            if slots[bus.senders[k], OWNER] == n:
                sends = True
        if sends:
            continue
        if good:
            if nodes[n, REC] > 127:
                nodes[n, REC] = 127
            elif nodes[n, REC] > 0:
                nodes[n, REC] -= 1
        else:
            nodes[n, REC] = min(nodes[n, REC] + 1, 255)
        _update_state(bus, n)
    for k in range(cells[SENDERS]):
        s = bus.senders[k]
        n = slots[s, OWNER]
        final = 1
        off = False
        if good:
            nodes[n, SENT] += 1
            nodes[n, TEC] = max(nodes[n, TEC] - 1, 0)
            _update_state(bus, n)
        else:
            nodes[n, ERRORS] += 1
            # A passive node that only misses the acknowledge counts no further: a lone node never becomes bus-off.
            if not (outcome == NO_ACKNOWLEDGE and nodes[n, STATE] == PASSIVE):
                nodes[n, TEC] += 8
            off = _update_state(bus, n)
            final = 1 if off else 0
        if nodes[n, ATTACHED] == 0:
            final = 1
        count = _store_result(out, count, s, start, end, outcome, slots, final)
        if final:
            _remove(bus, n, s)
        if nodes[n, STATE] == PASSIVE:
            nodes[n, SUSPENDED] = cells[FREE] + (8 * nominal_ps + 500) // 1000
        if off:
            for j in range(nodes[n, COUNT]):
                nodes[n, REFUSED] += 1
                count = _store_result(out, count, bus.queues[n, j], end, end, BUS_OFF, slots, 1)
            nodes[n, COUNT] = 0
            nodes[n, HEAD] = -1
            nodes[n, SUSPENDED] = 0
            nodes[n, LEFT] = _RECOVERY
            nodes[n, QUIET] = cells[FREE]
            nodes[n, RECOVERING] = 1
    cells[SENDERS] = 0
    return count


@njit(cache=True, error_model="numpy")
def advance(bus, until, out, nominal_ps, data_ps, chance):
    """Run the bus up to `until`; nothing starts exactly then, as a frame of higher priority may still be offered.

    Args:
        bus: State.
        until: Time [ns].
        out: Results, shape (at least the queues' room + 2 nodes, RESULT_COLUMNS).
        nominal_ps: Bit time of the arbitration [ps].
        data_ps: Bit time of the data phase [ps].
        chance: Probability of an error per bit.

    Returns:
        Number of results; `MORE` is set if `out` was full before the time was reached.
    """
    cells, nodes, slots = bus.cells, bus.nodes, bus.slots
    run_ns = (_RECESSIVE_RUN * nominal_ps + 500) // 1000
    room = out.shape[0] - bus.queues.shape[0] * (bus.queues.shape[1] + 2)
    count = 0
    cells[MORE] = 0
    while True:
        if count >= max(room, 1):  # without a node the room is 0, which is enough
            cells[MORE] = 1
            return count
        arrival = _INFINITE
        if cells[NEXT] < cells[ARRIVALS]:
            arrival = slots[bus.arrivals[cells[NEXT]], AT]
        if cells[SENDERS] > 0:
            if arrival < until and arrival < cells[END]:
                count = _admit(bus, out, count)
                continue
            if cells[END] > until:
                break
            count = _complete(bus, out, count, nominal_ps)
            continue
        start = _INFINITE
        for n in range(nodes.shape[0]):
            if nodes[n, COUNT] > 0:
                start = min(start, max(cells[FREE], nodes[n, SUSPENDED]))
        if arrival <= start and arrival < until:
            cells[FREE] = max(cells[FREE], arrival)
            _rejoin(bus, arrival, run_ns)
            count = _admit(bus, out, count)
            continue
        if start >= until:
            _rejoin(bus, until, run_ns)
            break
        _rejoin(bus, start, run_ns)
        _start_transmission(bus, start, nominal_ps, data_ps, chance)
    cells[NOW] = until
    close_windows(cells, cells[START] if cells[SENDERS] > 0 else until)
    return count
