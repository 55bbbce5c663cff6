"""``rawaug explore``: a page on your own machine that shows pictures as RAW of a camera."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from rawaug.data.demo import demo_files
from rawaug.errors import extra
from rawaug.explore.page import build, make_server, open_socket, socket_url
from rawaug.io.content import list_pictures


def run(pictures: str | None = None, /, *, isp: str = "universal", host: str = "127.0.0.1", port: int = 7860) -> None:
    """Show pictures as RAW of any camera, on a page in the browser.

    Args:
        pictures: a picture, or a folder of them; built-in ones by default.
        isp: ISP to open the page with: a shipped one by its name, a file, or the YAML file of your own camera.
        host: address to listen on; by default this machine alone can open the page.
        port: port to listen on.
    """
    with extra("explore"):  # one line names all that the page needs, before the pictures ask for theirs
        import gradio  # noqa: F401

    with TemporaryDirectory(prefix="rawaug-explore-") as uploads:  # not Gradio's own, in which other pages' files lie
        os.environ["GRADIO_TEMP_DIR"] = uploads
        page = build(*choices(pictures), isp=isp)
        with open_socket(host, port) as listener, suppress(KeyboardInterrupt):
            print(f"{socket_url(listener)} (press Ctrl-C to stop)", flush=True)
            make_server(page).run(sockets=[listener])


def choices(pictures: str | None) -> tuple[list[Path], list[str]]:
    """List the pictures to choose from, and their names on the page."""
    if pictures is None:
        files = demo_files()
        return files, [f"{file.stem} (built in)" for file in files]

    files = list_pictures(pictures).files
    folder = Path(pictures) if Path(pictures).is_dir() else Path(pictures).parent
    return files, [file.relative_to(folder).as_posix() for file in files]
