"""What a stranger's request can have of the page: its pictures and uploaded ones, and no other file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest

pytestmark = pytest.mark.long
FORM = b'--x\r\ncontent-disposition: form-data; name="files"; filename="own.png"\r\n\r\n%s\r\n--x--\r\n'


def post(url: str, body: bytes, content: str = "application/json") -> Any:
    """The answer, or the status if it is refused."""
    try:
        return json.load(urlopen(Request(url, body, {"content-type": content}), timeout=60))
    except HTTPError as error:
        return error.code


def upload_event(served: str) -> int:
    """The number of the event that opens an uploaded picture."""
    config = json.load(urlopen(f"{served}/config", timeout=60))
    types = {component["id"]: component["type"] for component in config["components"]}
    for event in config["dependencies"]:
        if "uploadbutton" in [types[component] for component in event["inputs"]]:
            return int(event["id"])
    raise AssertionError("no event takes an uploaded file")


def open_file(served: str, event: int, path: str) -> Any:
    """Send the event with this path; return the picture's number, or the status if it is refused."""
    file = {"path": path, "meta": {"_type": "gradio.FileData"}}
    body = {"data": [file], "fn_index": event, "session_hash": path}
    joined = post(f"{served}/gradio_api/queue/join", json.dumps(body).encode())
    if isinstance(joined, int):
        return joined
    for line in urlopen(f"{served}/gradio_api/queue/data?session_hash={path}", timeout=60):
        if b"process_completed" in line:
            message = json.loads(line.removeprefix(b"data:"))
            assert message["success"], message
            return message["output"]["data"][0]["value"]
    return None


def test_a_request_cannot_name_a_file_of_the_user(served: str, pictures: Path, tmp_path: Path) -> None:
    (tmp_path / "id_rsa").write_text("of the user")
    event = upload_event(served)
    form = FORM % (pictures / "own.png").read_bytes()
    (uploaded,) = post(f"{served}/gradio_api/upload", form, "multipart/form-data; boundary=x")
    number = open_file(served, event, uploaded)
    assert 2 <= number < 100, "behind the two pictures of the folder, and what others uploaded"

    (Path(uploaded).parent / "link.png").symlink_to(tmp_path / "id_rsa")
    strangers = [tmp_path / "id_rsa", "/etc/passwd", "http://127.0.0.1:1/own.png", pictures / "in" / "a.png"]
    strangers += [f"{uploaded}/../../../../{tmp_path}/id_rsa", Path(uploaded).with_name("link.png")]
    for path in map(str, strangers):
        assert open_file(served, event, path) == 403, path
    assert post(f"{served}/gradio_api/queue/join", b"data=no+JSON") == 403


def test_the_page_says_nothing_of_where_its_pictures_lie(served: str, pictures: Path) -> None:
    assert str(pictures).encode() not in urlopen(f"{served}/config", timeout=60).read()
