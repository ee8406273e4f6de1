"""The status page as a person sees it: a real Chromium, the built gateway, a broker and simulated devices.

    python3 tests/page/check.py BUSKER CHROMIUM FOLDER

mosquitto and its clients have to be in PATH. Screenshots go to FOLDER.
"""

import contextlib
import json
import pathlib
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request

from browser import PATIENCE, Browser

BUSKER, CHROMIUM, FOLDER = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
TOKEN = "a-token-for-the-test"

# A name that would be markup if somebody let it.
MARKUP = "<img src=x onerror=alert(1)>"

CONFIGURATION = """\
mqtt: {{url: 'mqtt://127.0.0.1:{broker}'}}
http: {{listen: '127.0.0.1:{http}', token: {token}}}
state_dir: {folder}/state
buses:
  basement: {{serial: {folder}/line}}
  plant: {{tcp: '127.0.0.1:{plant}', response_timeout: 200ms}}
  attic: {{tcp: '127.0.0.1:{nobody}'}}
devices:
  relays: {{profile: metz-connect/mr-do4, bus: basement, unit: 18, name: Heating relays}}
  inputs: {{profile: metz-connect/mr-ai8, bus: basement, unit: 19, name: Boiler room}}
  damper: {{profile: metz-connect/mr-dio42, bus: basement, unit: 20, name: Fire damper}}
  meter: {{profile: metz-connect/mr-sm3, bus: plant, unit: 21, name: Main meter}}
  missing: {{profile: metz-connect/mr-si4, bus: basement, unit: 22, name: Heat meters}}
  odd: {{profile: metz-connect/mr-di4, bus: plant, unit: 23, name: '{markup}'}}
  lost: {{profile: metz-connect/mr-do4, bus: attic, unit: 24, name: Attic fans}}
"""


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


class Program:
    """A program whose lines are read, and which ends with the test."""

    def __init__(self, *command):
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.lines = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def say(self, line):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def wait_for(self, part):
        end = time.monotonic() + PATIENCE
        while not any(part in line for line in list(self.lines)):
            if time.monotonic() > end or self.process.poll() is not None:
                raise AssertionError(f"`{part}` does not come:\n" + "\n".join(self.lines))
            time.sleep(0.05)

    def stop(self):
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(timeout=PATIENCE)


def get(address, token=None):
    """Status and headers."""
    request = urllib.request.Request(address)
    if token:
        request.add_header("Authorization", f"Bearer {token}")
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return answer.status, answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.headers


def row(device, name):
    """The text of a point's row, as JavaScript."""
    title = json.dumps(name)
    return (
        f"(() => {{ const row = [...document.querySelectorAll('#device-{device} tr')]"
        f".find((row) => row.cells[0].textContent === {title});"
        " return row && `${row.className}: ${row.cells[1].textContent.trim().replace(/\\s+/g, ' ')}`; })()"
    )


def main(stack):
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="busker-page-"))

    def start(*command):
        program = Program(*command)
        stack.callback(program.stop)
        return program

    ports = {name: free_port() for name in ("broker", "http", "plant", "nobody")}
    (pathlib.Path(folder) / "mosquitto.conf").write_text(
        f"listener {ports['broker']} 127.0.0.1\nallow_anonymous true\npersistence false\n"
    )
    start("mosquitto", "-c", f"{folder}/mosquitto.conf")
    basement = start(
        BUSKER, "simulate", "metz-connect/mr-do4@18", "metz-connect/mr-ai8@19", "metz-connect/mr-dio42@20",
        "--pty", f"{folder}/line", "--paced",
    )
    plant = start(
        BUSKER, "simulate", "metz-connect/mr-sm3@21", "metz-connect/mr-di4@23", "--tcp", f"127.0.0.1:{ports['plant']}"
    )
    for phase in (1, 2, 3):
        plant.say(f"unit 21 phase {phase} volts 230")
        plant.say(f"unit 21 phase {phase} amps {phase}.5")
        plant.say(f"unit 21 phase {phase} angle {(phase - 1) * 240}")
    configuration = pathlib.Path(folder) / "busker.yaml"
    configuration.write_text(CONFIGURATION.format(folder=folder, markup=MARKUP, token=TOKEN, **ports))
    gateway = start(BUSKER, "run", "--config", str(configuration))
    gateway.wait_for("HTTP on")
    address = f"http://127.0.0.1:{ports['http']}"

    def publish(topic, payload):
        subprocess.run(
            ["mosquitto_pub", "-p", str(ports["broker"]), "-t", f"busker/{topic}", "-m", payload], check=True
        )

    status, headers = get(address + "/")
    assert status == 401 and headers["Cache-Control"] == "no-store", (status, headers)

    page = Browser(CHROMIUM)
    stack.callback(page.close)
    page.size(1440, 1000)
    page.open(address + "/")

    # A person is asked for the token, and a wrong one is told.
    page.wait("!document.querySelector('#login').hidden", "the question for the token")
    page.screenshot(FOLDER / "login.png")
    expected = [complaint for complaint in page.complaints if "401" not in complaint]
    assert expected == [], expected
    page.type("wrong")
    page.press("Enter", 13, "\r")
    page.wait("!document.querySelector('#wrong').hidden", "the wrong token is told")
    page.evaluate("document.querySelector('#token').value = ''")
    page.type(TOKEN)
    page.press("Enter", 13, "\r")
    page.wait("document.querySelector('#live').innerText === 'live'", "the page lives")
    page.complaints.clear()

    # Devices that answer, with values; one that does not, with why; a bus that is down, with why.
    page.wait(row("relays", "Relay 1") + " === 'fresh: OFF'", "a relay")
    page.wait(row("meter", "Voltage of phase 1") + "?.startsWith('fresh: 230')", "a voltage")
    page.wait("document.querySelector('#device-meter .about').innerText.includes('METZ CONNECT GmbH MR-SM3')", "identity")
    offline = page.wait(
        "(() => { const why = document.querySelector('#device-missing .why');"
        " return !why.hidden && why.innerText.includes('3 times in a row') && why.innerText; })()", "why it is offline",
    )
    assert offline.startswith("offline: "), offline
    missing = page.evaluate("document.querySelector('#device-missing').innerText")
    assert "no answer yet" in missing, missing
    values = page.evaluate("[...document.querySelectorAll('#device-missing td.value')].map((cell) => cell.textContent)")
    assert len(values) == 48 and set(values) == {"—"}, values
    attic = page.evaluate("[...document.querySelectorAll('.bus')].find((bus) => bus.innerText.startsWith('attic')).innerText")
    assert "— requests/s" in attic and "— load" in attic and "refused" in attic, attic
    page.wait("document.querySelector('#status').innerText === 'lost: bus attic is down, 2 of 7 devices are offline'", "the state")

    # What a device is called is text, whatever it looks like.
    title = page.evaluate("document.querySelector('#device-odd h3').innerText")
    assert title == MARKUP, title

    # Changes come by themselves.
    publish("relays/relay_1/set", "ON")
    page.wait(row("relays", "Relay 1") + " === 'fresh: ON'", "the relay has switched")
    basement.say("unit 19 input 2 volts 7.5")
    page.wait(row("inputs", "Input 2") + "?.startsWith('fresh: 7.5')", "the voltage")

    # A thing made of several points: first in another mode, then with its state.
    assert page.evaluate("document.querySelector('#device-damper > .things').hidden")
    publish("damper/channel_1_mode/set", "fire_damper")
    basement.say("unit 20 input 1 contact closed")
    page.wait("document.querySelector('#device-damper > .things').innerText.includes('open')", "the damper is open")

    # An array is a curve, when somebody has asked for it.
    publish("meter/phase_1_outage_watched/set", "ON")
    page.wait("fetch('api/devices', {headers: {Authorization: 'Bearer ' + token}}).then((a) => a.json()).then((all) =>"
              " all.find((d) => d.name === 'meter').points.find((p) => p.name === 'phase_1_outage_watched').value === 'ON')",
              "the outage is watched for")
    plant.say("unit 21 phase 1 volts 0")
    page.wait(row("meter", "Outage of phase 1") + " === 'fresh: ON'", "the outage")
    for phase in (1, 2):
        publish(f"meter/phase_{phase}_waveform/get", "")
    page.wait("document.querySelectorAll('#device-meter figure svg').length === 2", "two curves")
    label = page.evaluate("document.querySelectorAll('#device-meter figure svg')[1].getAttribute('aria-label')")
    assert "128 values from -32" in label and label.endswith(" V"), label
    ticks = page.evaluate("[...document.querySelectorAll('#device-meter figure:last-child svg text')].map((t) => t.textContent)")
    assert "0" in ticks and "128" in ticks, ticks

    # What was last on the wire comes as a file, for who knows the token.
    page.ask("Page.setDownloadBehavior", behavior="allow", downloadPath=folder)
    page.evaluate("[...document.querySelectorAll('.bus')].find((bus) => bus.innerText.startsWith('basement')).querySelector('a.tape').click()")
    end = time.monotonic() + PATIENCE
    while not (files := list(pathlib.Path(folder).glob("basement-*Z.pcapng"))) and time.monotonic() < end:
        time.sleep(0.05)
    begin = files[0].read_bytes()[:12]
    assert begin[:4] == b"\n\r\r\n" and begin[8:] == b"M<+\x1a", begin

    # How a device does on its wire, for who looks.
    page.evaluate("[...document.querySelectorAll('#device-relays details')].pop().open = true")
    page.wait("/[0-9.]+ m?s turnaround \\(95 % within\\)/.test(document.querySelector('#device-relays').innerText)", "the turnaround")

    # Without a mouse: Tab comes to what can be opened, Enter opens it.
    page.evaluate("document.querySelector('#device-relays details.setting summary').focus()")
    page.press("Enter", 13, "\r")
    assert page.evaluate("document.querySelector('#device-relays details.setting').open")
    assert page.evaluate("document.querySelector('#device-relays details.setting table').innerText.includes('Watchdog')")
    page.evaluate("document.activeElement.blur()")
    page.press("Tab", 9)
    assert page.evaluate("document.activeElement.tagName") in ("A", "SUMMARY")
    page.evaluate("document.activeElement.blur()")

    # No wider than the window, neither here nor on a phone; and a picture of each.
    for name, size, scheme in [
        ("light", (1440, 1000), "light"), ("dark", (1440, 1000), "dark"), ("phone", (390, 844, True), "light"),
    ]:
        page.size(*size)
        page.scheme(scheme)
        wide = page.evaluate(
            "[...document.querySelectorAll('body *')].filter((place) => !place.closest('.unseen, svg')"
            f" && place.getBoundingClientRect().right > {size[0]} + 0.5)"
            ".map((place) => `${place.tagName} ${place.className} ${place.textContent.slice(0, 40)}`)"
        )
        assert wide == [], (name, wide)
        widths = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
        assert widths == [size[0], size[0]], (name, widths)
        page.screenshot(FOLDER / f"{name}.png")
        page.screenshot(FOLDER / f"{name}-whole.png", whole=True)
    page.size(1440, 1000)
    page.scheme("light")
    assert page.complaints == [], page.complaints

    # A device that falls silent takes its values with it.
    basement.say("unit 18 fault silent")
    page.wait(row("relays", "Relay 1") + " === 'missing: —'", "no value without its device")

    # Without the gateway nothing is shown as if it were fresh.
    gateway.stop()
    page.wait("document.body.classList.contains('lost') && !document.querySelector('#lost').hidden", "the loss is told")
    page.wait("![...document.querySelectorAll('tr.fresh')].length", "nothing is fresh any more")
    assert page.evaluate("document.querySelector('#status .dot').className") == "dot unknown"
    buses = page.evaluate("[...document.querySelectorAll('.bus')].map((bus) => bus.innerText)")
    assert all("— requests/s" in bus and "— load" in bus for bus in buses), buses
    page.screenshot(FOLDER / "lost.png")
    print(f"the page is as it should be; pictures of it are in {FOLDER}")


with contextlib.ExitStack() as everything:
    main(everything)
