"""The page in a real browser: every control, bad pictures, and that nothing is asked of another machine."""

from __future__ import annotations

import base64
import importlib.util
import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug.commands.explore import choices
from rawaug.explore import views as looks
from rawaug.explore.page import FIRST_SEED, open_socket
from rawaug.explore.views import pair as view

pytestmark = pytest.mark.long
WAIT = 60_000
"""Milliseconds; a busy machine is slow."""


@pytest.fixture(scope="module")
def chromium() -> str:
    """The browser, if all that the tests need is there."""
    if importlib.util.find_spec("playwright") is None:
        pytest.skip("playwright is not installed: pip install 'rawaug[test]'")
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium on this machine: apt install chromium")
    return found


@pytest.fixture(scope="module")
def browser(served: str, chromium: str) -> Iterator[Any]:
    """A tab of a headless Chromium that shows the page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        launched = started.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        tab = launched.new_page(viewport={"width": 1280, "height": 900})
        tab.set_default_timeout(WAIT)
        tab.asked = []
        tab.on("request", lambda request: tab.asked.append(request.url))
        tab.goto(served)
        tab.wait_for_selector("#view-pair img")
        yield tab
        launched.close()


def open_tab(browser: Any, name: str) -> None:
    browser.get_by_role("tab", name=name, exact=True).click()


def picked(browser: Any, control: str, choice: str) -> None:
    """Choose in a dropdown, whose list is narrowed by what one types."""
    field = browser.locator(f"#{control} input")
    field.fill("")
    field.press_sequentially(choice)
    browser.get_by_role("option", name=choice, exact=True).click()


def typed(browser: Any, control: str, choice: str) -> None:
    """Choose in a dropdown by its name."""
    field = browser.locator(f"#{control} input")
    field.click()
    field.fill(choice)
    field.press("Enter")
    assert field.input_value() == choice


def entered(browser: Any, control: str, number: str) -> None:
    field = browser.locator(f"#{control} input[type=number]")
    field.fill(number)
    field.press("Enter")
    field.blur()


def uploaded(browser: Any, file: Path) -> None:
    with browser.expect_file_chooser() as chooser:
        browser.locator("#upload").click()
    chooser.value.set_files(str(file))


def code(browser: Any, language: str = "command") -> str:
    """What the tab Code shows."""
    return str(browser.locator(f"#{language} .cm-content").inner_text())


def changed(browser: Any, view: str, before: str) -> str:
    """The first picture of a view, once it is another one."""
    browser.wait_for_function(
        "([view, before]) => { const found = document.querySelector(`#view-${view} img`);"
        " return found && found.src !== before }",
        arg=[view, before],
    )
    return first(browser, view)


def first(browser: Any, view: str) -> str:
    return str(browser.locator(f"#view-{view} img").first.get_attribute("src"))


def test_the_first_view_is_the_pair_that_the_code_makes(browser: Any, pictures: Path) -> None:
    urls = browser.eval_on_selector_all("#view-pair img", "found => found.map(image => image.src)")
    sent = [Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))) for url in urls]
    noisy, clean = (np.asarray(picture) for picture in sent)
    assert noisy.shape == clean.shape == (64, 96, 3)
    look = looks.Look(str(pictures / "in" / "a.png"), seed=FIRST_SEED)
    expected = view(look)[1].image
    assert np.abs(clean.astype(int) - expected.astype(int)).mean() < 3, "a JPEG of the same picture"
    open_tab(browser, "Code")
    made: dict[str, Any] = {}
    exec(code(browser, "python"), made)
    assert torch.equal(made["pair"].noisy, looks.make_example(look).pair.noisy)
    open_tab(browser, "Pair")


def test_every_tab_shows_its_pictures(browser: Any) -> None:
    for name, count in {"Stages": 5, "Eight draws": 8, "sRGB": 3, "Burst": 4}.items():
        open_tab(browser, name)
        view = name.lower().replace(" ", "-")
        browser.wait_for_function(f"document.querySelectorAll('#view-{view} img').length === {count}")
    open_tab(browser, "Denoise")
    browser.wait_for_function("document.querySelectorAll('#slider img').length >= 2")
    assert "denoised by rawaug-small" in browser.locator("#compared").inner_text()
    open_tab(browser, "Pair")


def test_every_control_changes_the_picture_and_the_code(browser: Any) -> None:
    from playwright.sync_api import TimeoutError as PlaywrightTimeout

    moves = [
        ("picture", lambda: picked(browser, "picture", "b.png"), "b.png"),
        ("camera", lambda: picked(browser, "camera", "Nikon D750"), "--camera 'Nikon D750'"),
        ("light", lambda: picked(browser, "light", "LED-B3"), "--light LED-B3"),
        ("tone", lambda: picked(browser, "tone", "linear"), "--tone linear"),
        ("draw_exposure", lambda: browser.locator("#draw_exposure input").uncheck(), "--exposure 0"),
        ("exposure", lambda: entered(browser, "exposure", "-1.5"), "--exposure=-1.5"),
        ("noise", lambda: picked(browser, "noise", "Google Pixel"), "--noise 'Google Pixel'"),
        ("iso", lambda: entered(browser, "iso", "3200"), "--iso 3200"),
        ("seed", lambda: entered(browser, "seed", "7"), "--seed 7"),
        ("cfa", lambda: picked(browser, "cfa", "XTRANS"), "--cfa XTRANS"),
        ("isp", lambda: picked(browser, "isp", "gopro-hero"), "--isp gopro-hero"),
    ]
    before = first(browser, "pair")
    for control, move, option in moves:
        move()
        try:
            before = changed(browser, "pair", before)
        except PlaywrightTimeout:
            pytest.fail(f"{control} did not change the picture; the command is {code(browser)}")
        browser.wait_for_function("() => !document.querySelector('[role=alert]')")
        open_tab(browser, "Code")
        browser.wait_for_function(
            "option => document.querySelector('#command .cm-content').innerText.replace(/\\s+/g, ' ').includes(option)",
            arg=option,
        )
        open_tab(browser, "Pair")
        assert control != "isp" or "--camera" not in code(browser), "a fitted ISP has no published cameras"
    picked(browser, "isp", "universal")
    changed(browser, "pair", before)


def test_a_choice_that_is_typed_again_stays(browser: Any) -> None:
    for _ in range(2):
        typed(browser, "camera", "Nikon D750")
    open_tab(browser, "Code")
    assert "--camera 'Nikon D750'" in code(browser)
    open_tab(browser, "Pair")


def test_what_cannot_be_is_said_on_the_page(browser: Any, pictures: Path) -> None:
    alert = browser.locator("[role=alert]")
    uploaded(browser, pictures / "broken.png")
    alert.wait_for()
    assert "broken.png" in alert.inner_text() and browser.locator("#view-pair img").count() == 0
    uploaded(browser, pictures / "own.png")
    browser.wait_for_selector("#view-pair img")
    open_tab(browser, "Code")
    browser.wait_for_function("document.querySelector('#command .cm-content').innerText.includes('own.png')")
    open_tab(browser, "Pair")
    picked(browser, "noise", "Google Pixel")
    entered(browser, "iso", "1000000")
    alert.wait_for()
    assert "outside the measured range of Google Pixel" in alert.inner_text()
    entered(browser, "iso", "800")
    browser.wait_for_selector("#view-pair img")
    assert alert.count() == 0


def test_nothing_is_asked_of_another_machine(browser: Any, served: str) -> None:
    assert served.startswith("http://127.0.0.1:")
    elsewhere = {url for url in browser.asked if not url.startswith((served, "data:", "blob:"))}
    assert not elsewhere
    fits = "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
    for width in (1280, 400):
        browser.set_viewport_size({"width": width, "height": 900})
        browser.wait_for_timeout(100)
        assert browser.evaluate(fits), f"the page is wider than {width} pixels"


def test_a_port_in_use_is_one_line() -> None:
    with open_socket("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=rf"{port}.*--port"):
            open_socket("127.0.0.1", port)


def test_what_can_be_chosen(pictures: Path) -> None:
    assert choices(str(pictures / "in"))[1] == ["a.png", "b.png"]
    assert choices(str(pictures / "in" / "a.png")) == ([pictures / "in" / "a.png"], ["a.png"])
    assert "chelsea (built in)" in choices(None)[1]
    with pytest.raises(FileNotFoundError, match="gone"):
        choices(str(pictures / "gone"))
    (pictures / "empty").mkdir()
    with pytest.raises(ValueError, match="contains no picture"):
        choices(str(pictures / "empty"))
