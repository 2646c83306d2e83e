"""What a file is that is not what its name promises, and what can be done about it."""

STARTS = {
    b"version https://git-lfs": "it is a Git LFS pointer: git lfs pull fetches the file itself",
    b"<!doctype": "it is a web page: download the file itself",
    b"<html": "it is a web page: download the file itself",
    b"gif8": "it is a GIF: convert it",
    b"riff": "it is WebP or a film: convert it",
    b"ii*\0": "it is TIFF or a camera's raw file: convert it",
    b"mm\0*": "it is TIFF or a camera's raw file: convert it",
    b"v/1\x01": "it is OpenEXR: convert it",
    b"pk\x03\x04": "it is a ZIP archive: unpack it",
    b"\xff\xfe": "it is UTF-16: save it as UTF-8",
    b"\xfe\xff": "it is UTF-16: save it as UTF-8",
}
HEAD = 32  # bytes that tell


def what_else(head: bytes, otherwise: str) -> str:
    """What a file with these first bytes is instead and how to go on, in words; `otherwise` if they do not tell."""
    if not head:
        return "it is empty: copy or export it again"
    if head[4:8] == b"ftyp":
        return "it is HEIC, AVIF or a film: convert it"
    lower = head[:HEAD].lower()
    return next((said for start, said in STARTS.items() if lower.startswith(start)), otherwise)
