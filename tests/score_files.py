"""Files of DAQs under test, in common formats."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from drivers.can.signals import messages_for
from tests.score_daqs import RATE_HZ
from tests.score_sessions import Sent, write_counts

Columns = Mapping[str, tuple[str, np.ndarray]]
"""Unit and values of each signal by name."""


def _texts(columns: Columns, times_s: np.ndarray | None) -> tuple[list[str], list[str], list[np.ndarray]]:
    names, units, values = list(columns), [unit for unit, _ in columns.values()], [v for _, v in columns.values()]
    if times_s is not None:
        names, units, values = ["time", *names], ["s", *units], [times_s, *values]
    return names, units, values


def _comma(path: Path, columns: Columns, times_s: np.ndarray | None, _: float) -> None:
    import pyarrow as pa
    from pyarrow import csv

    names, units, values = _texts(columns, times_s)
    heads = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    csv.write_csv(pa.table(values, heads), path)


def _lines(names: list[str], units: list[str], values: list[np.ndarray], mark: str, *, row: bool) -> list[str]:
    heads = names if row else [f"{n} ({u})" if u else n for n, u in zip(names, units, strict=True)]
    lines = [mark.join(heads), *([mark.join(units)] if row else [])]
    return lines + [mark.join(map(repr, line)) for line in zip(*(v.tolist() for v in values), strict=True)]


def _semicolon(path: Path, columns: Columns, times_s: np.ndarray | None, _: float) -> None:
    """Write CSV as a German spreadsheet does: decimal commas, CRLF, latin-1."""
    text = "\r\n".join(_lines(*_texts(columns, times_s), ";", row=False)).replace(".", ",")
    path.write_bytes((text + "\r\n").encode("latin-1", "replace"))


def _tab(path: Path, columns: Columns, times_s: np.ndarray | None, _: float) -> None:
    """Write tab-separated values with a line of units below the names."""
    path.write_text("\n".join(_lines(*_texts(columns, times_s), "\t", row=True)) + "\n", encoding="utf-8")


def _parquet(path: Path, columns: Columns, times_s: np.ndarray | None, _: float) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    names, units, values = _texts(columns, times_s)
    heads = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    parquet.write_table(pa.table(values, heads), path)


def _mdf(path: Path, columns: Columns, times_s: np.ndarray | None, rate_hz: float) -> None:
    from asammdf import MDF, Signal

    stamps = np.arange(len(next(iter(columns.values()))[1])) / rate_hz if times_s is None else times_s
    with MDF(version="4.10") as mdf:
        mdf.append([Signal(v, stamps, name=n, unit=u) for n, (u, v) in columns.items()], common_timebase=True)
        mdf.save(path)


def _tdms(path: Path, columns: Columns, times_s: np.ndarray | None, rate_hz: float) -> None:
    from nptdms import ChannelObject, TdmsWriter

    about = {"wf_increment": 1.0 / rate_hz, "wf_start_offset": 0.0 if times_s is None else float(times_s[0])}
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [ChannelObject("AI", name, v, {**about, "unit_string": u}) for name, (u, v) in columns.items()]
        )


def _uff(path: Path, columns: Columns, times_s: np.ndarray | None, rate_hz: float) -> None:
    import pyuff

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = pyuff.UFF(str(path))
        for number, (name, (unit, values)) in enumerate(columns.items(), 1):
            x = (0.0 if times_s is None else times_s[0]) + np.arange(len(values)) / rate_hz
            record = pyuff.prepare_58(
                binary=1, func_type=1, rsp_node=number, rsp_dir=1, ref_dir=1, ref_node=1, data=values.astype(float),
                x=x, id1=name, rsp_ent_name=name[:10], ref_ent_name="NONE", abscissa_spacing=1,
                ordinate_axis_units_lab=unit or "NONE", orddenom_spec_data_type=0,
            )  # fmt: skip
            file.write_sets(record, "add")
        del file
        gc.collect()


WRITERS: dict[str, tuple[str, Callable[..., None]]] = {
    "comma": (".csv", _comma), "semicolon": (".csv", _semicolon), "tab": (".txt", _tab),
    "parquet": (".parquet", _parquet), "mdf": (".mf4", _mdf), "tdms": (".tdms", _tdms), "uff": (".uff", _uff),
}  # fmt: skip
"""Suffix and writer of the formats for arbitrary values."""
COUNT_FORMATS = ("wav", "mcap", "candump", "asc", "blf")
"""Formats for counts of a DAQ."""
FORMATS = (*WRITERS, *COUNT_FORMATS)


def write_values(form: str, stem: Path, columns: Columns, times_s: np.ndarray | None, rate_hz: float) -> Path:
    """Write values in one of `WRITERS`; times are omitted if the format has a start and a step."""
    suffix, writer = WRITERS[form]
    path = stem.with_suffix(suffix)
    path.unlink(missing_ok=True)
    writer(path, columns, times_s, rate_hz)
    return path


def write_samples(form: str, stem: Path, sent: Sent, counts: np.ndarray, first: int) -> Path:
    """Write counts of consecutive rows of a session in one of `COUNT_FORMATS`."""
    if form == "wav":
        import soundfile

        bits = sent.channels[0].adc_bits
        width = next(each for each in (16, 24, 32) if each >= bits)
        path = stem.with_suffix(".wav")
        whole = (counts << (32 - bits)).astype(np.int32)
        soundfile.write(path, whole, RATE_HZ, subtype=f"PCM_{width}")
        return path
    if form == "mcap":
        path = stem.with_suffix(".mcap")
        path.unlink(missing_ok=True)
        return write_counts(path, sent, counts, first)
    return _can_log(stem.with_suffix({"candump": ".log"}.get(form, f".{form}")), sent, counts, first, fd=form != "asc")


def _can_log(path: Path, sent: Sent, counts: np.ndarray, first: int, *, fd: bool) -> Path:
    """Write the log of the rig's CAN bus: each message with its own rows."""
    import can

    messages = messages_for(sent.table)
    step, names = 2 if fd else 20, [c.name for c in sent.channels]
    skip = -first % step
    picked, frames = counts[skip::step], []
    for message in messages.fd if fd else messages.classic:
        form = message.samples
        if form is None or not {c.name for c in form.channels} <= set(names):
            continue
        rows = picked[:, [names.index(c.name) for c in form.channels]]
        starts = np.arange(0, len(rows) - form.rows + 1, form.rows)
        numbers = (first + skip) // step + starts
        data = form.pack(numbers if not fd else numbers * step, rows[: len(starts) * form.rows], message.length)
        for n, each in enumerate(data):
            stamp_s = (first + skip + (starts[n] + form.rows) * step) / RATE_HZ
            frames.append((stamp_s, message.identifier, each.tobytes()))
    with can.Logger(str(path)) as log:
        for stamp_s, identifier, data in sorted(frames):
            log(
                can.Message(
                    arbitration_id=identifier, data=data, is_fd=fd, is_extended_id=False, timestamp=1.7e9 + stamp_s
                )
            )
    return path
