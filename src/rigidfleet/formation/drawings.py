"""Outlines of drawings (SVG), as a browser draws them: what is hidden, or defined alone, is left out."""

from __future__ import annotations

import copy
import io
import re
from collections import Counter
from typing import Any
from xml.etree import ElementTree

import numpy as np
import svgelements.svgelements as svg

from rigidfleet.typing import Floats

_SPACE, _LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
#: Elements that are drawn, or hold such; all others are drawn where something refers to them, if at all.
_DRAWN = r"svg|g|a|switch|use|path|rect|circle|ellipse|line|polyline|polygon|text|tspan|image"
#: Properties that change what is seen of a shape, and are not followed.
_IGNORED = r"\b(clip-path|mask|filter|marker[-a-z]*|transform-(?:origin|box)|ref[XY])\s*[:=]\s*[\"']?\s*(?!none)[-\w.]"
#: An own style without opacity.
_UNSEEN = r"(?<![-\w])opacity\s*:\s*[0.]+%?\s*(;|!|$)"
#: Lengths, and of which side of the view around (2: its diagonal) they may be shares.
_SIDES = {key: side for side, keys in enumerate(("x cx x1 x2 rx width", "y cy y1 y2 ry height", "r"))
          for key in keys.split()}  # fmt: skip
#: Attributes that ask for more than a browser may have.
_ASKS = {"systemLanguage", "requiredExtensions", "requiredFeatures"}
#: Rules of a style sheet that hold for some media alone, and selectors that depend on more than the element.
_BLOCKS = r"@[^{};]*(?:;|\{(?:[^{}]|\{[^{}]*\})*\})"
_SELECTORS = r"[^\s{},][^{},]*[\s>+~:\[][^\s{},][^{},]*(?=[,{][^{}]*[{}])"
#: Where a curve and a line are measured.
_CURVE, _LINE = np.linspace(0.0, 1.0, 200), np.array([0.0, 1.0])
#: Greatest number of elements, and of those around one: references can stand for any number.
_MOST, _DEEP = 20_000, 200


class Drawing:
    """A drawing that is read.

    Attributes
    ----------
    outlines : polygons (K, 2), y down; a closed one ends where it begins
    notes : what of the drawing is not drawn, or not as a browser does it, and how often

    Raises
    ------
    ValueError
        It is no drawing, or too large.
    """

    def __init__(self, data: bytes) -> None:
        root = ElementTree.fromstring(data)
        if _tag(root) != "svg":
            raise ValueError(f"begins with <{root.tag}>")
        self.outlines: list[Floats] = []
        self.notes, self._count = Counter[str](), 0
        self._ids = {x.get("id"): copy.deepcopy(x) for x in reversed(list(root.iter()))}
        sheet = "".join(x.text or "" for x in root.iter() if _tag(x) == "style")
        sheet = re.sub(r"/\*.*?\*/", "", sheet, flags=re.S)
        size = [_length(root.get("width", "300"), 300.0), _length(root.get("height", "150"), 150.0)]
        size = _numbers_in_text(root.get("viewBox", f"0 0 {size[0]} {size[1]}"))[2:]
        self._expand_references(root, size)
        root.tag = _SPACE + "svg"
        style = ElementTree.Element(_SPACE + "style")
        style.text = re.sub(_BLOCKS, "", sheet)
        root.insert(0, style)
        text = re.sub(r"\s*!important", "", ElementTree.tostring(root, encoding="unicode"))
        unread = re.findall(_BLOCKS, sheet) + re.findall(_SELECTORS, style.text)
        self.notes.update(f"style rule '{' '.join(x.split())[:40]}' is not read" for x in unread)
        ignored = re.findall(_IGNORED, text)
        self.notes.update(f"{key} is not followed: all is drawn" for key in ignored)
        page = svg.SVG.parse(io.StringIO(text), ppi=96, width=size[0], height=size[1])
        for element in page.elements():
            if isinstance(element, svg.Shape | svg.Text | svg.Image):
                self._add_outlines(element)

    def _expand_references(self, element: Any, size: Any, depth: int = 0) -> None:
        """Turn references and views into groups that hold what they show; ``size`` is that of the view around."""
        self._count += 1
        if self._count > _MOST or depth > _DEEP:
            raise ValueError(f"draws more than {_MOST:,} elements, or one inside itself")
        tag, own = _tag(element), element.attrib
        if _is_zero(own.get("opacity")) or re.search(_UNSEEN, own.get("style", "")):
            own["style"] = f"{own.get('style', '')};display:none"  # whatever those inside say
        whole = (*size, np.hypot(*size) / np.sqrt(2.0))
        for key in _SIDES.keys() & own.keys():
            own[key] = str(_length(own[key], whole[_SIDES[key]]))
        if tag == "switch":  # a browser takes the first that it supports
            fits = [x for x in element if re.fullmatch(_DRAWN, _tag(x)) and not _ASKS & {*x.keys()}]
            element[:] = fits[:1]
        element.tag = _SPACE + ("g" if tag in ("svg", "use", "switch") else tag)
        if tag == "use":
            link = own.pop("href", own.pop(_LINK, ""))
            if (target := copy.deepcopy(self._ids.get(link[1:]))) is None:
                self.notes[f"{link!r} is referred to, and not in the file"] += 1
            else:
                element.append(target)
                if _tag(target) in ("svg", "symbol"):
                    target.tag = _SPACE + "svg"
                    target.attrib.update({k: own[k] for k in ("width", "height") if k in own})
        if tag in ("svg", "use"):
            x, y = (float(own.pop(key, 0)) for key in "xy")
            w, h = (
                float(own.pop(key, x)) for key, x in zip(("width", "height"), size, strict=True)
            )
            move = f"translate({x},{y})"
            if tag == "svg":
                box = _numbers_in_text(own.pop("viewBox", f"0 0 {w} {h}"))
                fit = own.pop("preserveAspectRatio", None)
                move, size = svg.Viewbox.viewbox_transform(x, y, w, h, *box, fit), box[2:]
            own["transform"] = f"{own.get('transform', '')} {move}"
        for child in list(element):
            if re.fullmatch(_DRAWN, _tag(child)):
                self._expand_references(child, size, depth + 1)
            else:
                element.remove(child)

    def _add_outlines(self, element: Any) -> None:
        """Add the outlines of a shape that is filled or stroked, and seen."""
        style = {"fill": "black", "stroke": "none"} | element.values
        if style.get("visibility") in ("hidden", "collapse") or _is_zero(style.get("opacity")):
            return
        if not isinstance(element, svg.Shape):
            words = " ".join((getattr(element, "text", None) or "").split())
            self.notes[f"{style['tag']} {words!r} is not drawn: convert it to paths"] += 1
            return
        filled, stroked = (
            style[key] != "none"
            and svg.Color(style[key]).alpha != 0
            and not _is_zero(style.get(f"{key}-opacity"))
            for key in ("fill", "stroke")
        )
        filled &= style["tag"] != "line"
        if not filled and (not stroked or _is_zero(style.get("stroke-width"))):
            self.notes["shape without fill and stroke is not drawn"] += 1
            return
        if filled:
            self.notes["fill is drawn by its edge, without colour"] += 1
        for part in map(svg.Path, abs(svg.Path(element)).as_subpaths()):
            segments = list(part)[1:]
            ends = [x.npoint(_LINE if isinstance(x, svg.Linear) else _CURVE) for x in segments]
            if ends:
                first = ends[0][:1]
                points = [first, *(x[1:] for x in ends), *([first] if filled else [])]
                self.outlines.append(np.concatenate(points))


def _tag(element: Any) -> str:
    """Name of an element of SVG; "" for one of another kind."""
    space, _, tag = str(element.tag).rpartition("}")
    return tag if space in ("", _SPACE[:-1]) else ""


def _numbers_in_text(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"[^\s,]+", text)]


def _length(text: str, whole: float) -> float:
    return float(svg.Length(text).value(ppi=96, relative_length=whole, font_size=16))


def _is_zero(text: str | None) -> bool:
    return bool(re.fullmatch(r"[0.]+(px|%)?", text or "1"))
