"""A person at the live view: a headless Chromium that clicks."""

from collections.abc import Callable
import shutil
import time
from typing import Any, Self

from metagcttt_tools.benchmarks.audience import HEADLESS
from metagcttt_tools.live.scene import viewpoint
import numpy as np
import pytest
from selenium import webdriver
from selenium.common.exceptions import WebDriverException
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from sim_bridge import MazeMap

CHROMIUM, DRIVER = shutil.which('chromium'), shutil.which('chromedriver')
needs_chromium = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason='no Chromium with a driver here: tools/chromium.sh as root'
)
_FIELD_OF_VIEW = np.radians(75)  # vertical


def drawn_at(
    maze: MazeMap, point: tuple[float, float, float], width: float, height: float
) -> tuple[float, float]:
    """Pixels from the middle of a picture, to the right and down, at which a point is drawn."""
    camera, target = (np.array(place) for place in viewpoint(maze, width / height))
    ahead = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(ahead, (0, 0, 1)) / np.linalg.norm(np.cross(ahead, (0, 0, 1)))
    ray = np.array(point) - camera
    seen = np.array((ray @ right, -(ray @ np.cross(right, ahead)))) / (ray @ ahead)
    x, y = seen * height / 2 / np.tan(_FIELD_OF_VIEW / 2)
    return float(x), float(y)


class Browser:
    """A tab with the live view."""

    def __init__(self, url: str, maze: MazeMap, size: tuple[int, int] = (1000, 560)) -> None:
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        for option in HEADLESS:
            options.add_argument(option)
        self._maze = maze
        self.driver = webdriver.Chrome(options=options, service=Service(DRIVER))
        width, height = size  # of the page; a window is never narrower than 500
        metrics = {'width': width, 'height': height, 'deviceScaleFactor': 1, 'mobile': False}
        self.driver.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', metrics)
        self.driver.get(url)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.quit()

    def text(self) -> str:
        return self.driver.find_element(By.TAG_NAME, 'body').text

    def click_floor(self, xy: tuple[float, float]) -> None:
        """Click where a point of the floor is drawn, by a camera that nobody has moved."""
        canvas = self.driver.find_element(By.TAG_NAME, 'canvas')
        x, y = drawn_at(self._maze, (*xy, 0.0), canvas.rect['width'], canvas.rect['height'])
        webdriver.ActionChains(self.driver).move_to_element_with_offset(
            canvas, round(x), round(y)
        ).click().perform()

    def click_button(self, label: str) -> None:
        self._click(f'//button[.//*[text()="{label}"]]')

    def click_checkbox(self, label: str) -> None:
        self._input(label).click()

    def type_number(self, label: str, text: str) -> None:
        field = self._input(label)
        field.send_keys(Keys.CONTROL, 'a')
        field.send_keys(text)
        field.send_keys(Keys.TAB)

    def choose(self, label: str, option: str) -> None:
        self._input(label).click()
        self.wait(
            lambda: self._click(f'//*[@role="option"][normalize-space()="{option}"]') or True,
            f'the option {option}',
        )

    def _input(self, label: str) -> Any:
        return self.driver.find_element(
            By.XPATH, f'//*[normalize-space()="{label}"]/following::input[1]'
        )

    def _click(self, xpath: str) -> None:
        self.driver.find_element(By.XPATH, xpath).click()

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float = 120.0) -> Any:
        """Wait until `condition` gives something true; the page may be drawn anew meanwhile."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                if result := condition():
                    return result
            except WebDriverException:
                pass
            assert time.monotonic() < deadline, f'waited in vain for {what}'
            time.sleep(0.1)

    def wait_for_text(self, text: str) -> None:
        self.wait(lambda: text in self.text(), f'{text!r} on the page')
