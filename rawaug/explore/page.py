"""The page: controls on one side, a tab for each view on the other; every change redraws only the open tab.

Nothing is loaded from elsewhere and nothing is sent: pictures are data in the page, and fonts are the system's. The
server reads the pictures it was started with and those that were uploaded, which requests name by a number; a request
that names any other file is refused.
"""

from __future__ import annotations

import base64
import io
import json
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from rawaug.bayer import PATTERNS
from rawaug.camera.lights import LAMPS
from rawaug.camera.matrices import load_cameras
from rawaug.errors import MissingExtra, escape, extra
from rawaug.explore import views
from rawaug.explore.views import VIEWS, Look, Panel
from rawaug.files import WEIGHTS
from rawaug.plugin.config import AugmentConfig
from rawaug.plugin.draw import Draw


def as_html(panels: Sequence[Panel]) -> str:
    """Lay out pictures with their titles as a grid in HTML."""
    templates = Environment(loader=PackageLoader(__package__, ""), autoescape=True)
    templates.filters["data_url"] = data_url
    return templates.get_template("panels.html").render(panels=panels)


def message(text: str) -> str:
    """Write an error as HTML."""
    return str(Markup('<div class="message" role="alert">{}</div>').format(escape(text)))


def data_url(image: np.ndarray) -> str:
    """Encode uint8 ``(H, W, 3)`` as a JPEG of full colour resolution, which keeps noise."""
    with extra("explore"):
        from PIL import Image

    content = io.BytesIO()
    Image.fromarray(image).save(content, "JPEG", quality=92, subsampling=0)
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"


ANY, OWN = "any", "the ISP's"
KELVINS = (2000, 2500, 2856, 3200, 4000, 5000, 5500, 6500, 7500, 10000)
DENOISE = "Denoise"
FIRST_SEED = 2
"""The page starts with this seed, which gives the first built-in picture ordinary noise; 0 nearly the strongest."""


def parse_look(values: Mapping[str, Any]) -> Look:
    """Read the values of the controls, by their names; raise ValueError if no picture is chosen."""
    picture = values["picture"]
    if not picture:
        raise ValueError("choose a picture")

    light = values["light"]
    if light.endswith(" K"):
        light = int(light.removesuffix(" K"))
    else:
        light = _unless_any(light)
    draw = Draw(
        exposure=None if values["draw_exposure"] else values["exposure"],
        light=light,
        tone=_unless_any(values["tone"]),
    )

    config = AugmentConfig(
        isp=values["isp"],
        camera=_unless_any(values["camera"]),
        noise=values["noise"],
        iso=values["iso"] or None,
        draw=draw,
        cfa=None if values["cfa"] == OWN else values["cfa"],
    )
    return Look(str(picture), views.drop_inapplicable(config), int(values["seed"] or 0))


def _unless_any(choice: str) -> str | None:
    if choice == ANY:
        return None
    return choice


def show(tab: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Draw the open tab.

    Args:
        tab: name of the tab.
        values: values of the controls, by their names.

    Returns:
        Everything that changes on the page: ``message``, ``python``, ``command``, and the tab's content by its name.
    """
    try:
        look = views.with_tab(tab, parse_look(values))
        if tab == DENOISE:
            before, after = views.denoise(look)
            images = (before.image, after.image)
            return {"message": "", tab: images, "compared": f"{before.title} | {after.title}", **_code(look)}
        return {"message": "", tab: as_html(VIEWS[tab](look)), **_code(look)}
    except (ValueError, OSError, MissingExtra) as error:
        changes: dict[str, Any] = {"message": message(str(error)), "python": "", "command": ""}
        if tab == DENOISE:
            return changes | {tab: None, "compared": ""}
        return changes | {tab: ""}


def _code(look: Look) -> dict[str, str]:
    return {"python": views.python(look), "command": views.command(look)}


def build(pictures: Sequence[Path], names: Sequence[str] | None = None, isp: str = "universal") -> Any:
    """Build the page as Gradio's Blocks.

    Args:
        pictures: files to choose from, besides uploaded ones.
        names: their names on the page; those of the files by default.
        isp: the ISP that is selected at first, by its name or path.
    """
    views.load_isp(isp)  # raises here rather than on the page
    os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"
    with extra("explore"):
        import gradio as gr

    if names is None:
        names = [picture.name for picture in pictures]
    files = list(pictures)

    private = {"analytics_enabled": False, "delete_cache": (3600, 86400)}  # uploads go when the page stops
    with gr.Blocks(title="rawaug explore", fill_width=True, **private) as page:
        gr.HTML("<h1>Your pictures as RAW</h1>")
        outputs: dict[str, Any] = {"message": gr.HTML(elem_id="message")}
        with gr.Row(elem_id="layout"):
            with gr.Column(scale=1, min_width=300, elem_id="controls"):
                controls = _controls(gr, files, names, isp)
            with gr.Column(scale=3, min_width=300, elem_id="views"), gr.Tabs(overflow_behavior="wrap"):
                tabs = {name: _tab(gr, name, outputs) for name in (*VIEWS, DENOISE)}
                with gr.Tab("Code"):
                    gr.Markdown("Python and the command that make this very pair.")
                    form = {"interactive": False, "wrap_lines": True, "show_line_numbers": False, "buttons": ["copy"]}
                    outputs["python"] = gr.Code(label="Python", language="python", elem_id="python", **form)
                    outputs["command"] = gr.Code(label="Command", language="shell", elem_id="command", **form)
        _connect(gr, page, files, controls, outputs, tabs)
    return page


def _controls(gr: Any, files: list[Path], names: Sequence[str], isp: str) -> dict[str, Any]:
    """Make the controls; a picture is named by its number in ``files``, to which uploaded ones are appended."""
    choices = [(name, number) for number, name in enumerate(names)]
    isps = sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))
    if isp not in isps:
        isps.insert(0, isp)
    cameras = sorted(set(load_cameras().names), key=str.casefold)
    kelvins = [f"{kelvin} K" for kelvin in KELVINS]
    noise = str(AugmentConfig(isp).noise)

    controls: dict[str, Any] = {}
    whole = {"num_choices_shown": None}  # in a list shown in part, a retyped choice gives way to the first one
    with gr.Group():
        controls["picture"] = gr.Dropdown(choices, value=0 if choices else None, label="Picture", **whole)
        upload = gr.UploadButton("Open your own", size="sm", elem_id="upload")

    with gr.Group():
        controls["isp"] = gr.Dropdown(isps, value=isp, label="ISP")
        controls["camera"] = gr.Dropdown([ANY, *cameras], value=ANY, label="Camera", **whole)
        controls["light"] = gr.Dropdown([ANY, *kelvins, *LAMPS], value=ANY, label="Light", **whole)
        controls["tone"] = gr.Dropdown([ANY, *views.tone_names(isp)], value=ANY, label="Tone curve", **whole)
        controls["draw_exposure"] = gr.Checkbox(True, label="Draw the exposure at random")
        controls["exposure"] = gr.Slider(-4, 1, value=0, step=0.25, label="Exposure (stops)", interactive=False)

    with gr.Group():
        controls["noise"] = gr.Dropdown(views.noise_choices(isp), value=noise, label="Noise", **whole)
        controls["iso"] = gr.Number(0, label="ISO", info=_about_iso(noise), interactive=False)
        controls["cfa"] = gr.Dropdown([OWN, *PATTERNS], value=OWN, label="CFA")
        controls["seed"] = gr.Number(FIRST_SEED, label="Seed", precision=0, minimum=0)
    for name, control in controls.items():
        control.elem_id = name

    def add_picture(upload: str) -> Any:
        require_uploaded(upload)
        files.append(Path(upload))
        number = len(files) - 1
        return gr.update(choices=[*choices, (Path(upload).name, number)], value=number)

    upload.upload(add_picture, upload, controls["picture"], show_progress="hidden", api_visibility="private")
    return controls


def _tab(gr: Any, name: str, outputs: dict[str, Any]) -> Any:
    view = VIEWS.get(name, views.denoise)
    with gr.Tab(name) as tab:
        gr.Markdown(str(view.__doc__).partition("\n")[0])  # what it shows
        if name == DENOISE:
            outputs["compared"] = gr.HTML(elem_id="compared")
            outputs[name] = gr.ImageSlider(show_label=False, format="png", elem_id="slider", max_height=560)
        else:
            outputs[name] = gr.HTML(elem_id=f"view-{name.lower().replace(' ', '-')}")
    return tab


def _connect(
    gr: Any, page: Any, files: Sequence[Path], controls: dict[str, Any], outputs: dict[str, Any], tabs: dict[str, Any]
) -> None:
    opened = gr.Textbox(next(iter(VIEWS)), visible="hidden")  # the name of the open tab
    quiet = {"show_progress": "hidden", "api_visibility": "private"}

    for name, tab in tabs.items():
        tab.select(None, None, opened, js=f"() => {json.dumps(name)}", **quiet)

    def redraw(tab: str, *values: Any) -> list[Any]:
        by_name = dict(zip(controls, values, strict=True))
        if by_name["picture"] is not None:
            by_name["picture"] = files[by_name["picture"]]
        changes = show(tab, by_name)

        model = by_name["noise"]
        changes["exposure"] = gr.update(interactive=not by_name["draw_exposure"])
        changes["iso"] = gr.update(interactive=views.iso_range(model) is not None, info=_about_iso(model))
        return [changes.get(name, gr.skip()) for name in changing]

    # One event draws everything, so that no late answer to an older one replaces a newer picture. The others are rare
    # or stay in the browser, since Gradio may lose the answer to one of two events that run at once.
    changing = outputs | {"exposure": controls["exposure"], "iso": controls["iso"]}
    inputs = list(controls.values())
    triggers = [page.load, opened.change, *(control.change for control in inputs)]
    gr.on(triggers, redraw, [opened, *inputs], list(changing.values()), trigger_mode="always_last", **quiet)

    isp, noise = controls["isp"], controls["noise"]
    dependent = [controls["camera"], controls["light"], controls["tone"], noise]
    isp.change(partial(_update_choices, gr), [isp, controls["tone"], noise], dependent, **quiet)


def _update_choices(gr: Any, isp: str, tone: str, noise: str) -> list[Any]:
    """Offer cameras, lights and tones only of published cameras, and an ISP's own noise only with this ISP."""
    published = bool(views.load_isp(isp).config.cameras)
    tones = [ANY, *views.tone_names(isp)]
    noises = views.noise_choices(isp)

    tone_changes: dict[str, Any] = {"interactive": published, "choices": tones}
    if tone not in tones:
        tone_changes["value"] = ANY
    noise_changes: dict[str, Any] = {"choices": noises}
    if noise not in noises:
        noise_changes["value"] = AugmentConfig().noise

    camera, light = gr.update(interactive=published), gr.update(interactive=published)
    return [camera, light, gr.update(**tone_changes), gr.update(**noise_changes)]


def _about_iso(noise: str) -> str:
    limits = views.iso_range(noise)
    if limits is None:
        return "this noise model has no ISO"
    return f"0: drawn from {limits[0]:g} to {limits[1]:g}"


def upload_folder() -> Path:
    """Return the folder in which Gradio keeps uploaded files, :envvar:`GRADIO_TEMP_DIR`."""
    from gradio.utils import get_upload_folder

    return Path(get_upload_folder()).resolve()


def require_uploaded(path: str) -> None:
    """Raise ValueError unless a file lies in the folder of uploaded files."""
    if not Path(path).resolve().is_relative_to(upload_folder()):
        raise ValueError(f"{path}: was not uploaded")


class UploadsOnly:
    """ASGI middleware that refuses requests which name a file that was not uploaded.

    Gradio takes a copy of any file that a request names, and serves the copy. It checks the name only on pages that
    it has launched itself, which a mounted page is not.
    """

    def __init__(self, app: Any) -> None:
        self.app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Pass a request on, with its body, or answer it with status 403."""
        from starlette.requests import Request
        from starlette.responses import PlainTextResponse

        if scope["type"] != "http" or scope["path"].endswith("/upload"):  # its body is the file itself
            await self.app(scope, receive, send)
            return

        body = await Request(scope, receive).body()
        try:
            for path in _paths_in(json.loads(body or b"null")):
                require_uploaded(path)
        except (ValueError, OSError, RecursionError) as error:
            await PlainTextResponse(escape(error), 403)(scope, receive, send)
            return

        pending = [{"type": "http.request", "body": body}]

        async def receive_again() -> Any:
            return pending.pop() if pending else await receive()

        await self.app(scope, receive_again, send)


def _paths_in(value: Any) -> Iterator[str]:
    """Find the files that a request names, anywhere in its JSON."""
    if isinstance(value, Mapping):
        if isinstance(value.get("path"), str):
            yield value["path"]
        value = list(value.values())
    if isinstance(value, list):
        for inner in value:
            yield from _paths_in(inner)


def make_server(page: Any) -> Any:
    """Make uvicorn's server of a page; ``server.run(sockets=[...])`` runs it until it is interrupted."""
    with extra("explore"):
        import fastapi
        import gradio as gr
        import uvicorn

    theme = gr.themes.Base(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"])
    form = {"theme": theme, "css_paths": Path(__file__).with_name("page.css"), "footer_links": []}

    app = gr.mount_gradio_app(fastapi.FastAPI(), page, "/", ssr_mode=False, **form)
    app.add_middleware(UploadsOnly)
    return uvicorn.Server(uvicorn.Config(app, log_level="error"))


def open_socket(host: str, port: int) -> socket.socket:
    """Open a socket for :func:`make_server`; port 0 takes any free one. Raise OSError if the port is unusable."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise OSError(f"port {port} of {host} cannot be used ({error.strerror}); choose another --port") from None


def socket_url(open_: socket.socket) -> str:
    """Return the address that a browser opens."""
    host, port = open_.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
