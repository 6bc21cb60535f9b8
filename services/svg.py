"""Pictures as text of SVG files: what drawings share."""

from xml.etree import ElementTree

LETTER, BOLD_LETTER = 0.57, 0.70  # mean widths, of the font's size
INK, GREY, FAINT, PANEL = "#1c2430", "#5d6673", "#9aa3af", "#f4f6f8"
STYLE = "text { font-family: system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif; }"
Point = tuple[float, float]


def new_svg(title: str, size: tuple[float, float]) -> ElementTree.Element:
    """A white picture of so many pixels (width, height)."""
    width, height = (f"{edge:.0f}" for edge in size)
    place = {"viewBox": f"0 0 {width} {height}", "width": width, "height": height}
    svg = ElementTree.Element("svg", {"xmlns": "http://www.w3.org/2000/svg", **place})
    ElementTree.SubElement(svg, "title").text = title
    ElementTree.SubElement(svg, "style").text = STYLE
    rect(svg, (0, 0, *size), fill="white")
    return svg


def as_text(svg: ElementTree.Element) -> str:
    """The file's text."""
    ElementTree.indent(svg)
    return ElementTree.tostring(svg, encoding="unicode") + "\n"


def rect(parent: ElementTree.Element, box: tuple[float, float, float, float], **style: str) -> None:
    """A rectangle: left, top, width, height."""
    names = ("x", "y", "width", "height")
    place = {name: f"{value:.1f}" for name, value in zip(names, box, strict=True)}
    ElementTree.SubElement(parent, "rect", {**place, **style})


def text(
    parent: ElementTree.Element, place: Point, words: str, size: float, color: str, *, bold: bool = False
) -> ElementTree.Element:
    """A line of text that begins at a place on its base line."""
    weight = {"font-weight": "600"} if bold else {}
    given = {
        "x": f"{place[0]:.1f}",
        "y": f"{place[1]:.1f}",
        "font-size": f"{size:g}",
        "fill": color,
        **weight,
    }
    element = ElementTree.SubElement(parent, "text", given)
    element.text = words
    return element
