"""Vector pages in exact size: black rectangles and plain text, in millimetres, as PDF 1.4.

Rectangles of a page are one path, so that no viewer shows seams where they touch.

Source: ISO 32000-1, 7.5 (file structure), 8.5 (paths), 9.4 (text).
"""

from __future__ import annotations

from dataclasses import dataclass

from cdpr.poses import Array

POINTS_A_MM = 72.0 / 25.4


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text.

    Attributes:
        x_mm: Of its start, from the left.
        y_mm: Of its base line, from the top.
        size_mm: Of the letters.
        text: Printable ASCII.
    """

    x_mm: float
    y_mm: float
    size_mm: float
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """A page.

    Attributes:
        width_mm: Of the paper.
        height_mm: Of the paper.
        black_mm: Left, top, width and height of black rectangles, from the top left, shape (n, 4).
        texts: On top of them.
    """

    width_mm: float
    height_mm: float
    black_mm: Array
    texts: tuple[Text, ...]


def pdf_of(pages: list[Page], title: str) -> bytes:
    """The whole file.

    Args:
        pages: One or more.
        title: Printable ASCII.
    """
    kids = " ".join(f"{4 + 2 * k} 0 R" for k in range(len(pages)))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for number, page in enumerate(pages):
        box = f"[0 0 {page.width_mm * POINTS_A_MM:.4f} {page.height_mm * POINTS_A_MM:.4f}]"
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents {5 + 2 * number} 0 R"
            " /Resources << /Font << /F1 3 0 R >> >> >>".encode()
        )
        drawn = _drawn(page)
        objects.append(b"<< /Length %d >>\nstream\n%s\nendstream" % (len(drawn), drawn))
    objects.append(f"<< /Title ({_escaped(title)}) /Producer (cdpr) >>".encode())
    return _file(objects)


def _drawn(page: Page) -> bytes:
    """The operators of a page; one unit is a millimetre, y runs down."""
    scale = f"{POINTS_A_MM:.10f}"
    lines = [f"{scale} 0 0 -{scale} 0 {page.height_mm * POINTS_A_MM:.6f} cm", "0 g"]
    lines += [f"{x:.5f} {y:.5f} {w:.5f} {h:.5f} re" for x, y, w, h in page.black_mm.tolist()]
    lines.append("f")
    for text in page.texts:
        place = f"1 0 0 -1 {text.x_mm:.4f} {text.y_mm:.4f} Tm"
        lines.append(f"BT /F1 {text.size_mm:.3f} Tf {place} ({_escaped(text.text)}) Tj ET")
    return "\n".join(lines).encode("ascii")


def _escaped(text: str) -> str:
    plain = text.encode("ascii", "replace").decode()
    return plain.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")


def _file(objects: list[bytes]) -> bytes:
    """Objects numbered from 1, the table of their places, and the trailer."""
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    for place in places:
        out += b"%010d 00000 n \n" % place
    out += b"trailer\n<< /Size %d /Root 1 0 R /Info %d 0 R >>\n" % (len(objects) + 1, len(objects))
    out += b"startxref\n%d\n%%%%EOF\n" % start
    return bytes(out)
