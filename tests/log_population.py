"""Logs of other laboratories by seed: names and units of many habits around signals of the second rig.

The families in HELD_OUT_NAMES were written before the tables of words, and are not a source for them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from replays.recordings.formats.source import Entry, FileSignal
from tests.second_rig import UNITS, Motion, record_log, simulate_pulse

CHANNELS = tuple(UNITS)
_KINDS = ("probe",) * 4 + ("force",) * 4 + ("acceleration",) * 4 + ("speed", "keyphasor", "hammer")
KNOWN = {
    "american": (
        "Disk Prox Horizontal|Disk Prox Vertical|Ring Prox Horizontal|Ring Prox Vertical|Load Cell Top|"
        "Load Cell Bottom|Load Cell Right|Load Cell Left|Accel Inner Horiz|Accel Inner Vert|Accel Outer Horiz|"
        "Accel Outer Vert|Motor Speed|Tach|Impact Hammer"
    ),
    "german": (
        "Weg Scheibe waagerecht|Weg Scheibe senkrecht|Weg Ring waagerecht|Weg Ring senkrecht|Kraft oben|Kraft unten|"
        "Kraft rechts|Kraft links|Beschl. innen H|Beschl. innen V|Beschl. außen H|Beschl. außen V|Drehzahl|"
        "Lichtschranke|Hammer"
    ),
    "french": (
        "Dépl. disque horizontal|Dépl. disque vertical|Dépl. anneau horizontal|Dépl. anneau vertical|Effort haut|"
        "Effort bas|Effort droite|Effort gauche|Accél. intérieur X|Accél. intérieur Y|Accél. extérieur X|"
        "Accél. extérieur Y|Vitesse|Top tour|Marteau"
    ),
    "spanish": (
        "Desplazamiento disco X|Desplazamiento disco Y|Desplazamiento anillo X|Desplazamiento anillo Y|Fuerza arriba|"
        "Fuerza abajo|Fuerza derecha|Fuerza izquierda|Aceleración interior X|Aceleración interior Y|"
        "Aceleración exterior X|Aceleración exterior Y|Velocidad|Pulso|Martillo"
    ),
    "italian": (
        "spostamento_disco_x|spostamento_disco_y|spostamento_anello_x|spostamento_anello_y|forza_alto|forza_basso|"
        "forza_destra|forza_sinistra|acc_interno_x|acc_interno_y|acc_esterno_x|acc_esterno_y|giri|fase|martello"
    ),
    "short": "probe_dx|probe_dy|probe_rx|probe_ry|fN|fS|fE|fW|accInX|accInY|accOutX|accOutY|n|kph|hammer",
}
HELD_OUT_NAMES = {
    "polish": (
        "Przem. tarczy X|Przem. tarczy Y|Przem. pierścienia X|Przem. pierścienia Y|Siła góra|Siła dół|Siła prawo|"
        "Siła lewo|Drgania obud. wewn. X|Drgania obud. wewn. Y|Drgania obud. zewn. X|Drgania obud. zewn. Y|Obroty|"
        "Znacznik fazy|Młotek"
    ),
    "dutch": (
        "Verplaatsing schijf hor.|Verplaatsing schijf vert.|Verplaatsing ring hor.|Verplaatsing ring vert.|"
        "Kracht boven|Kracht onder|Kracht rechts|Kracht links|Versn. binnenhuis X|Versn. binnenhuis Y|"
        "Versn. buitenhuis X|Versn. buitenhuis Y|Toerental|Fasepuls|Hamer"
    ),
    "portuguese": (
        "Desloc. disco H|Desloc. disco V|Desloc. anel H|Desloc. anel V|Célula de carga cima|Célula de carga baixo|"
        "Célula de carga direita|Célula de carga esquerda|Acel. carcaça int. H|Acel. carcaça int. V|"
        "Acel. carcaça ext. H|Acel. carcaça ext. V|Rotação|Ref. fase|Martelo"
    ),
    "ni": (
        "cDAQ1Mod1/ai0 DiskX|cDAQ1Mod1/ai1 DiskY|cDAQ1Mod1/ai2 StatorX|cDAQ1Mod1/ai3 StatorY|"
        "cDAQ1Mod2/ai0 LC_Up|cDAQ1Mod2/ai1 LC_Down|cDAQ1Mod2/ai2 LC_Right|cDAQ1Mod2/ai3 LC_Left|"
        "cDAQ1Mod3/ai0 HsgIn_X|cDAQ1Mod3/ai1 HsgIn_Y|cDAQ1Mod3/ai2 HsgOut_X|cDAQ1Mod3/ai3 HsgOut_Y|"
        "cDAQ1Mod4/ctr0 Freq|cDAQ1Mod4/ai0 Trig|cDAQ1Mod3/ai4 Hammer"
    ),
    "vibration": (
        "1-ADxH|2-ADxV|3-BDxH|4-BDxV|F12h|F6h|F3h|F9h|CasingA-H|CasingA-V|CasingB-H|CasingB-V|1xRPM|Tacho1|ImpHam 8206"
    ),
    "hbm": (
        "MX840B_CH 1 S_Rotor_1|MX840B_CH 2 S_Rotor_2|MX840B_CH 3 S_Fanglager_1|MX840B_CH 4 S_Fanglager_2|U9C_1|U9C_2|"
        "U9C_3|U9C_4|B12_1|B12_2|B12_3|B12_4|T40_Drehzahl|T40_Index|8206"
    ),
    "bare": "|".join(f"CH{n}" for n in range(1, 16)),
    "wav": "|".join(f"channel {n}" for n in range(1, 16)),
    "none": "|".join(f"column {n}" for n in range(2, 17)),
    "czech": (
        "Výchylka disku X|Výchylka disku Y|Výchylka kroužku X|Výchylka kroužku Y|Síla nahoře|Síla dole|"
        "Síla vpravo|Síla vlevo|Zrychlení vnitřní těleso X|Zrychlení vnitřní těleso Y|Zrychlení vnější těleso X|"
        "Zrychlení vnější těleso Y|Otáčky|Fázová značka|Rázové kladívko"
    ),
    "swedish": (
        "Läge skiva horis.|Läge skiva vert.|Läge ring horis.|Läge ring vert.|Kraft upp|Kraft ner|Kraft höger|"
        "Kraft vänster|Acc innerhus X|Acc innerhus Y|Acc ytterhus X|Acc ytterhus Y|Varvtal|Varvpuls|Slaghammare"
    ),
    "turkish": (
        "Disk yer değ. yatay|Disk yer değ. düşey|Halka yer değ. yatay|Halka yer değ. düşey|Kuvvet üst|Kuvvet alt|"
        "Kuvvet sağ|Kuvvet sol|İvme iç gövde yatay|İvme iç gövde düşey|İvme dış gövde yatay|İvme dış gövde düşey|"
        "Devir|Faz referansı|Darbe çekici"
    ),
    "catman": (
        "Wegaufnehmer 1 (Scheibe X)|Wegaufnehmer 2 (Scheibe Y)|Wegaufnehmer 3 (Fangring X)|"
        "Wegaufnehmer 4 (Fangring Y)|KMD N|KMD S|KMD O|KMD W|Beschl_Innenring_X|Beschl_Innenring_Y|"
        "Beschl_Aussenring_X|Beschl_Aussenring_Y|Drehzahl_n|Nulllage|Impulshammer_F"
    ),
    "mts": (
        "Rotor Disp Lat|Rotor Disp Vert|Catcher Disp Lat|Catcher Disp Vert|LC1 Top|LC2 Bottom|LC3 Right|LC4 Left|"
        "Accel1 InnerFrame Lat|Accel2 InnerFrame Vert|Accel3 OuterFrame Lat|Accel4 OuterFrame Vert|Shaft RPM|"
        "Index|Modal Hammer"
    ),
    "dewesoft": (
        "AI 1;Rotor X|AI 2;Rotor Y|AI 3;Ring X|AI 4;Ring Y|AI 5;F top|AI 6;F bottom|AI 7;F right|AI 8;F left|"
        "AI 9;Inner X|AI 10;Inner Y|AI 11;Outer X|AI 12;Outer Y|CNT 1;Frequency|DI 1;Tacho|AI 13;Impact"
    ),
    "famos": (
        "Weg_Sch_X|Weg_Sch_Y|Weg_Ri_X|Weg_Ri_Y|Kraft_N|Kraft_S|Kraft_O|Kraft_W|a_IG_x|a_IG_y|a_AG_x|a_AG_y|"
        "n_Welle|Trigger_n|F_Hammer"
    ),
}
BARE = ("bare", "wav", "none")
_MAP = dict(zip(CHANNELS, _KINDS, strict=True))
_SPELLINGS = {
    "probe": (("mm", 1.0), ("µm", 1e3), ("mil", 1e3 / 25.4), ("V", 7.87), ("UM", 1e3)),
    "force": (("N", 1.0), ("lbf", 1 / 4.4482216), ("kN", 1e-3), ("V", 1e-3), ("daN", 0.1)),
    "acceleration": (("m/s²", 1.0), ("g", 1 / 9.80665), ("V", 0.0102), ("m/s^2", 1.0)),
    "speed": (("Hz", 1.0), ("rpm", 60.0), ("1/min", 60.0), ("RPM", 60.0)),
    "keyphasor": (("V", 5.0), ("", 1.0)),
    "hammer": (("N", 1.0), ("lbf", 1 / 4.4482216), ("V", 2.25e-3)),
}
_STYLES = ("field", "field", "bracket", "suffix", "missing")


class Log(NamedTuple):
    """A drawn log: its family, entries, signals and true channels, in the same order."""

    family: str
    style: str
    entries: list[Entry]
    signals: list[FileSignal]
    truth: list[str]


def simulate_motions(count: int) -> list[Motion]:
    return [
        simulate_pulse(speed_hz=hz, force_n=force_n, turned=turned)
        for hz, force_n, turned in ((6.2, 100.0, 0.2), (5.3, 85.0, 2.0), (7.6, 140.0, 4.0))[:count]
    ]


def draw_log(motions: list[Motion], family: str, seed: int) -> Log:
    """Draw a log: rate, noise, offsets and units of its sensors, and the order and spelling of its signals."""
    number = [*KNOWN, *HELD_OUT_NAMES].index(family)
    rng = np.random.default_rng([seed, number])
    rate_hz = float(rng.choice([5000.0, 10_000.0, 20_000.0, 25_600.0]))
    motion = motions[int(rng.integers(len(motions)))]
    _, found = record_log(
        motion, seed=seed, rate_hz=rate_hz, bandwidth_hz=0.4 * rate_hz, noise=float(rng.choice([1.0, 3.0, 10.0]))
    )
    style = "missing" if family in BARE else _STYLES[(seed + number) % len(_STYLES)]
    choice = {kind: options[int(rng.integers(len(options)))] for kind, options in _SPELLINGS.items()}
    names = dict(zip(CHANNELS, ({**KNOWN, **HELD_OUT_NAMES}[family]).split("|"), strict=True))
    order = list(CHANNELS)
    if family not in BARE or rng.random() < 0.5:
        rng.shuffle(order)
    if family in BARE:  # their names are in the order of the file
        names = dict(zip(order, names.values(), strict=True))
    entries, signals = [], []
    for channel in order:
        kind = _MAP[channel]
        unit, scale = choice[kind]
        values = found[channel]
        if kind == "probe":
            values = values + (0.05 * rng.standard_normal() if unit != "V" else -1.27 + 0.03 * rng.standard_normal())
        elif kind == "force":
            values = values * (1.0 + 0.01 * rng.standard_normal())
        values = values * scale
        if family == "wav":
            values = values / (1.2 * np.abs(values).max())
        name, unit_field = names[channel], unit
        if style == "bracket" and unit:
            name, unit_field = f"{name} [{unit}]", ""
        elif style == "suffix" and len(unit) > 1 and unit.isalpha():
            name, unit_field = f"{name}_{unit}", ""
        elif style == "missing":
            unit_field = ""
        entries.append(Entry(name, "", unit_field, len(values), rate_hz))
        signals.append(FileSignal(values, rate_hz=rate_hz))
    return Log(family, style, entries, signals, order)
