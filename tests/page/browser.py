"""A headless Chromium that is told what to do through the pipe that it offers for that (no port is opened)."""

import base64
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time

# Nothing takes this long unless it never comes.
PATIENCE = 30


class Browser:
    def __init__(self, program):
        self.profile = tempfile.TemporaryDirectory(prefix="busker-page-", ignore_cleanup_errors=True)
        orders_in, orders = os.pipe()
        answers, answers_out = os.pipe()
        options = [
            "--headless=new", "--remote-debugging-pipe", "--no-first-run", "--disable-gpu", "--hide-scrollbars",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            "--force-color-profile=srgb", "--lang=en", f"--user-data-dir={self.profile.name}",
        ]
        if os.getuid() == 0:
            # Chromium's sandbox does not work for root, and the page is ours.
            options.append("--no-sandbox")
        # The browser reads orders from 3 and answers on 4. First out of the way of each other.
        become = (
            "import os, sys; ends = [os.dup(int(end)) for end in sys.argv[1:3]];"
            " [os.dup2(end, 100 + number) for number, end in enumerate(ends)];"
            " os.dup2(100, 3); os.dup2(101, 4); os.execvp(sys.argv[3], sys.argv[3:])"
        )
        self.process = subprocess.Popen(
            [sys.executable, "-c", become, str(orders_in), str(answers_out), program, *options, "about:blank"],
            pass_fds=(orders_in, answers_out), stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        os.close(orders_in)
        os.close(answers_out)
        self.orders = os.fdopen(orders, "wb")
        self.answers = os.fdopen(answers, "rb")
        self.number = 0
        self.waiting = {}
        self.complaints = []
        threading.Thread(target=self._hear, daemon=True).start()
        targets = self._ask("Target.getTargets")["targetInfos"]
        page = next(target for target in targets if target["type"] == "page")
        attached = self._ask("Target.attachToTarget", targetId=page["targetId"], flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def _hear(self):
        waiting = b""
        while chunk := self.answers.read1(1 << 16):
            *whole, waiting = (waiting + chunk).split(b"\0")
            for message in map(json.loads, whole):
                if "id" in message:
                    self.waiting.pop(message["id"]).put(message)
                elif message["method"] == "Log.entryAdded":
                    entry = message["params"]["entry"]
                    self.complaints.append(f'{entry["level"]}: {entry["text"]} {entry.get("url", "")}')
                elif message["method"] == "Runtime.exceptionThrown":
                    self.complaints.append(json.dumps(message["params"]["exceptionDetails"]))
                elif message["method"] == "Runtime.consoleAPICalled":
                    self.complaints.append(json.dumps(message["params"]["args"]))

    def _ask(self, method, **params):
        return self._order({"method": method, "params": params})

    def ask(self, method, **params):
        """Something of the page."""
        return self._order({"method": method, "params": params, "sessionId": self.session})

    def _order(self, order):
        self.number += 1
        answer = self.waiting[self.number] = queue.Queue()
        self.orders.write(json.dumps({"id": self.number, **order}).encode() + b"\0")
        self.orders.flush()
        message = answer.get(timeout=PATIENCE)
        if "error" in message:
            raise RuntimeError(f'{order["method"]}: {message["error"]}')
        return message["result"]

    def open(self, url):
        self.ask("Page.navigate", url=url)

    def size(self, width, height, phone=False):
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height,
                 deviceScaleFactor=2 if phone else 1, mobile=phone)

    def scheme(self, name):
        self.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def evaluate(self, expression):
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f'{expression}: {answer["exceptionDetails"]}')
        return answer["result"].get("value")

    def wait(self, expression, what):
        """Until the expression is true; returns its value."""
        end = time.monotonic() + PATIENCE
        while True:
            try:
                value = self.evaluate(expression)
            except RuntimeError:
                # What it speaks of is not there yet.
                value = None
            if value:
                return value
            if time.monotonic() > end:
                text = self.evaluate("document.body.innerText")
                raise AssertionError(f"{what}: `{expression}` does not come true. The page says:\n{text}\n{self.complaints}")
            time.sleep(0.05)

    def press(self, key, code, text=""):
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code,
                     text=text if kind == "keyDown" else "")

    def type(self, text):
        self.ask("Input.insertText", text=text)

    def screenshot(self, path, whole=False):
        answer = self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole,
                          **({"clip": self._whole()} if whole else {}))
        with open(path, "wb") as file:
            file.write(base64.b64decode(answer["data"]))

    def _whole(self):
        size = self.ask("Page.getLayoutMetrics")["cssContentSize"]
        return {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}

    def close(self):
        try:
            self._ask("Browser.close")
            self.process.wait(timeout=PATIENCE)
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()
            self.profile.cleanup()
