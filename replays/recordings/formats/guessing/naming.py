"""Parsing of signal names, in the languages and conventions of test benches: quantity, place and direction."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass

from rig.base import units

_KINDS = {
    "hammer": "hammer hammerkraft impulshammer impacthammer schlag impact marteau martillo martello",
    "keyphasor": "keyphasor keyph kph kphi key phasor phasenmarke phasenreferenz lichtschranke nullimpuls drehgeber "
    "onceperrev onceperturn pulse pulses impuls pulso impulso tour topzero index phase fase",
    "tach": "tach tacho tachometer",
    "speed": "rpm upm drehzahl speed spin vitesse velocidad velocita giri regime toeren omega",
    "acceleration": "acc accel accelerometer acceleration beschl beschleunigung accelerometre aceleracion "
    "accelerazione accelerometro acelerometro versnelling iepe icp vib vibration",
    "force": "kraft kraftmessdose force forces fuerza forza load loadcell effort kracht transducer kistler f fx fy p "
    "fn fs fe fw fo pn ps pe pw po",
    "length": "weg wegsonde wegaufnehmer sonde probe prox proximity proximiter displacement disp position pos "
    "gap abstand wirbelstrom eddy eddycurrent deplacement depl desplazamiento spostamento verplaatsing orbit taster "
    "d s dx dy rx ry",
}  # fmt: skip
"""Quantities by words; the first match counts, so that a hammer's force is a hammer. A tach is a speed or pulses."""
_PLACES = {
    "disk": "disk disc scheibe rotorscheibe disque disco schijf rotor dx dy",
    "ring": "ring statorring anneau anillo anello stator fanglager backup rx ry",
    "inner": "in inner innen innenring innengehaeuse interieur interior interno binnen",
    "outer": "out outer aussen aussengehaeuse exterieur exterior esterno buiten",
}
_AXES = {
    "x": "x ax fx dx rx h hor horiz horizontal horizontale orizzontale waagrecht waagerecht",
    "y": "y ay fy dy ry v ver vert vertical verticale vertikal senkrecht lotrecht",
}
_SIDES = {
    "N": "n fn pn north nord norte noord noorden norden top upper up above oben oberer haut superieur arriba superior "
    "alto sopra",
    "S": "s fs ps south sued sud sur zuid sueden bottom lower down below unten unterer bas inferieur abajo inferior "
    "basso sotto",
    "E": "e fe pe east ost est este oost osten right rechts droite derecha destra",
    "W": "w fw pw west ouest oeste ovest westen left links gauche izquierda sinistra",
}  # fmt: skip
_NAME_UNITS = ("length", "force", "acceleration", "speed of rotation", "voltage")
"""Quantities whose units are read from a name."""
_NAME_UNIT = re.compile(
    r"(.+?)\s*(?:[\[(]\s*([^\])]+?)\s*[\])]|[\s_.,:]([A-Za-zµμ/²^0-9-]+"
    r"(?:[\s_](?:pp|p-p|pk|pk-pk|rms))?))\s*",
    re.IGNORECASE,
)
_CLOCK = re.compile(r"(?<!\d)(12|3|6|9)(?:h|\s?(?:[Uu]hr|o'?clock))(?![A-Za-z0-9])")
_CLOCK_SIDES = {"12": "N", "3": "E", "6": "S", "9": "W"}
"""Sides by positions of a clock seen from the drive; `3 H` is a third, horizontal signal."""
_LONE_O = ("o", "fo", "po")
_O = {"E": "W", "W": "E"}
"""Side meant by a lone `O`, by the other side that is named: Ost with W, Ouest or Oeste with E."""
_MIN_INNER_LENGTH = 4
"""Minimum length of a word that is also found inside another, as in German compounds."""


def _words(texts: Mapping[str, str]) -> dict[str, str]:
    return {word: key for key, words in texts.items() for word in words.split()}


_PLACE_OF, _AXIS_OF, _SIDE_OF = map(_words, (_PLACES, _AXES, _SIDES))
_NUMBERING = _words({"": "ai ch chan channel kanal voie canal canale column col spalte signal sig track input"})
"""Words of a name that only numbers a signal."""


@dataclass(frozen=True)
class ParsedName:
    """Content of a signal name; fields are empty if the name does not have them.

    Attributes:
        kind: Quantity: `length`, `force`, `acceleration`, `speed`, `keyphasor`, `tach` or `hammer`.
        kind_word: Word that gave the quantity.
        place: `disk`, `ring`, `inner` or `outer`.
        axis: `x` or `y`.
        side: `N`, `S`, `E`, `W`, or `O`, which is Ost or Ouest.
        side_letter: True if the side is a single letter, which may also be part of a unit.
        bare: True if the name only numbers the signal.
    """

    kind: str = ""
    kind_word: str = ""
    place: str = ""
    axis: str = ""
    side: str = ""
    side_letter: bool = False
    bare: bool = False

    def resolve_side(self, others: set[str]) -> str:
        """Return the side; the sides of the other forces resolve `O`."""
        if self.side != "O":
            return self.side
        return next((_O[other] for other in ("W", "E") if other in others), "E")


def split_words(name: str) -> list[str]:
    """Return the words of a name in lower case without accents: `Sonde_X2` gives sonde, x, 2; ä gives ae."""
    text = name.replace("ß", "ss")
    for umlaut, plain in zip("äöüÄÖÜ", ("ae", "oe", "ue", "Ae", "Oe", "Ue"), strict=True):
        text = text.replace(umlaut, plain)
    text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)
    return re.findall(r"[a-z]+|\d+", text.lower())


def read_name(name: str) -> ParsedName:
    """Return the content of a signal name."""
    clock = _CLOCK.search(name)
    words = split_words(name if clock is None else name.replace(clock[0], " "))
    kind, kind_word = "", ""
    for wanted in _KINDS:
        kind_word = _find_word(words, dict.fromkeys(_KINDS[wanted].split(), wanted))[1]
        if kind_word:
            kind = wanted
            break
    rest = [word for word in words if word != kind_word or len(kind_word) > 1]
    side_word = next((word for word in reversed(rest) if word in _SIDE_OF or word in _LONE_O), "")
    side = _CLOCK_SIDES[clock[1]] if clock else _SIDE_OF.get(side_word, side_word[-1:].upper())
    axis = _find_word(words, _AXIS_OF)[0]
    if words == ["n"]:
        kind = "speed"
    bare = all(word.isdigit() or word in _NUMBERING for word in words)
    return ParsedName(
        kind, kind_word, _find_word(words, _PLACE_OF)[0], axis, side, not clock and len(side_word) == 1, bare
    )


def split_unit(name: str) -> tuple[str, str]:
    """Return a name without the unit at its end, and the unit: in brackets, or at least two letters or `g`."""
    match = _NAME_UNIT.fullmatch(name)
    unit = (match[2] or match[3]) if match else ""
    letter = bool(match and match[3]) and ((len(unit) < 2 and unit != "g") or unit.lower() == "in")
    plain = units.split_detector(unit)[0]
    if match is None or letter or units.get_quantity(plain) not in _NAME_UNITS:
        return name, ""
    return match[1], unit


def _find_word(words: list[str], keys: dict[str, str]) -> tuple[str, str]:
    """Return key and word of the first match: a whole word first, else a long one inside another."""
    for word in words:
        if word in keys:
            return keys[word], word
    for word in words:
        for inside, key in keys.items():
            if len(inside) >= _MIN_INNER_LENGTH and inside in word:
                return key, inside
    return "", ""
