"""The live dashboard over HTTP: pages, pictures, what it refuses."""

import http.client
import json
import urllib.error
import urllib.request
from html.parser import HTMLParser
from urllib.parse import quote, urlsplit

import pytest

from src.dashboard import render as render_module
from src.dashboard.render import asset
from src.dashboard.single_file import export_dashboard
from src.report.sweep_record import record_path, write_record
from tests.dashboard.experiments import World, epsilon, serve


def get(address, **headers):
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


def raw(base, method, path, host=None):
    """A request whose path is sent as it is."""
    connection = http.client.HTTPConnection(urlsplit(base).netloc, timeout=20)
    connection.putrequest(method, path, skip_host=host is not None)
    if host is not None:
        connection.putheader("Host", host)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read()


RUN = World.run_id(0, 0)


@pytest.mark.parametrize(
    "path",
    ["/", "/sweep/epsilon_mini", f"/run/{RUN}", f"/run/{World.run_id(1, 1)}", f"/run/{RUN}?against=nothing",
     f"/run/{RUN}?against={World.run_id(2, 0)}"],
)  # fmt: skip
def test_pages_come_with_a_policy_that_allows_nothing_else(served, path):
    status, text, headers = get(served + path)
    assert status == 200 and b"</html>" in text
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy and "http" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert b"http://" not in text.replace(b"http://127.0.0.1", b"") and b"https://" not in text


def test_pictures_are_the_files(served, shared_world):
    status, content, headers = get(f"{served}/pictures/{RUN}/frame_0_abc.png")
    assert (status, headers["content-type"]) == (200, "image/png")
    assert content == (shared_world.outputs / RUN / "pictures" / "frame_0_abc.png").read_bytes()


@pytest.mark.parametrize(
    "path",
    ["/pictures/../secret.txt", "/pictures/..%2f/secret.txt", f"/pictures/{RUN}/..%2f..%2f..%2fsecret.txt",
     f"/pictures/{RUN}/../log.txt", f"/pictures/{RUN}/..%2flog.txt", f"/pictures/{RUN}/%2fetc%2fpasswd",
     f"/pictures/{RUN}/frame_0_abc.png%00", f"/pictures/{RUN}/nothing.png", "/sweep/..%2fsecret", "/run/..",
     "/run/horizon3d-phase1-mini-99999999", "/sweep/nothing_mini", "/templates/style.css", "/docs",
     f"/pictures/{RUN}/..%252f..%252fsecret.txt", f"/pictures/{RUN}/%2e%2e%2f%2e%2e%2fsecret.txt",
     f"/pictures/{RUN}/..%5c..%5csecret.txt", f"/pictures/{RUN}/..%c0%af..%c0%afsecret.txt", "//etc/passwd",
     "/../secret.txt",
     "/%2e%2e/secret.txt", f"/pictures/%2e%2e/{RUN}", "/pictures//etc/passwd", f"/pictures/{RUN}/file:///etc/passwd",
     f"/pictures/{RUN}%00/frame_0_abc.png", "/run/%00", "/reports/results", "/openapi.json", "/static/..%2fsecret.txt"],
)  # fmt: skip
def test_what_is_not_listed_is_not_there(served, path):
    status, content = raw(served, "GET", path)
    assert status == 404 and b"secret" not in content


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "", "0.0.0.0", "localhost.evil.example",
     "evil.example:127.0.0.1", "localhost@evil.example", "evil.example#localhost", "127.0.0.2", "[::1]", "2130706433"],
)  # fmt: skip
def test_other_names_of_this_machine_are_refused(served, host):
    assert raw(served, "GET", "/", host)[0] == 400
    assert raw(served, "GET", f"/pictures/{RUN}/frame_0_abc.png", host)[0] == 400


def test_names_of_this_machine_are_served(served):
    assert raw(served, "GET", "/", "localhost:1234")[0] == raw(served, "GET", "/", "127.0.0.1")[0] == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "PROPFIND"])
def test_nothing_can_be_changed(served, method):
    for path in ("/", f"/run/{RUN}", "/sweep/epsilon_mini", f"/pictures/{RUN}/frame_0_abc.png", "/mark"):
        assert raw(served, method, path)[0] == 405, path
    assert raw(served, method, "/run/nothing")[0] == 405


def test_the_head_of_a_page_can_be_asked_for(served):
    for path in ("/", f"/run/{RUN}", f"/pictures/{RUN}/frame_0_abc.png"):
        assert raw(served, "HEAD", path) == (200, b"")
    assert raw(served, "HEAD", "/", "evil.example")[0] == 400


def test_a_socket_cannot_be_opened_from_another_page(served):
    """Web sockets are not held to one origin by browsers; there are none here."""
    wanted = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
              "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Origin": "http://evil.example"}  # fmt: skip
    for path in ("/", "/mark"):
        assert get(served + path, **wanted)[0] != 101


EVIL = {
    "script": "<script>alert(1)</script>",
    "attribute": '" onmouseover=alert(1) x="',
    "single": "' onfocus='alert(1)' autofocus='",
    "comment": "--><img src=x onerror=alert(1)>",
    "closing": "</title></style></textarea></svg><svg onload=alert(1)>",
    "template": "{{ cycler.__init__.__globals__.os.popen('id') }}{% raw %}",
    "address": "javascript:alert(1)//",
}


@pytest.mark.slow
@pytest.mark.parametrize("evil", EVIL.values(), ids=EVIL)
def test_words_of_strangers_are_shown_and_never_obeyed(world, evil):
    """As title, question, label, plot, axis, command, reason, log, setting, name of data, of a class and of a file."""
    record = world.reports / "sweeps" / "epsilon_mini.json"
    content = json.loads(record.read_text())
    sweep = content["sweep"]
    sweep |= {"title": evil, "question": evil, "source": evil}
    sweep["tables"][0]["title"] = evil
    sweep["plots"][0]["label"] = evil
    old = sweep["rows"][0]["label"]
    sweep["rows"][0]["label"] = evil
    content["rows"][evil] = content["rows"].pop(old)
    for run in content["runs"].values():
        run["label"] = evil if run["label"] == old else run["label"]
        run["reason"] = evil
        run["worker"] = evil
    content |= {"command": evil, "study": evil, "storage": evil}
    record.write_text(json.dumps(content))
    path = world.reports / "results" / f"{RUN}.json"
    result = json.loads(path.read_text())
    result |= {"overrides": [f"model.x={evil}"], "device": evil, "commit": evil, "initialized_from": evil}
    result["versions"] = {evil: evil}
    result["skipped_files"] = {evil: 1}
    result["data"] |= {"name": evil, "root": evil, "version": evil, "split": evil}
    result["config"] = {evil: {"x": evil}}
    result["curves"] = {f"loss/{evil}": [[1, 2.0], [2, 3.0]]}
    path.write_text(json.dumps(result))
    (world.outputs / RUN / "log.txt").write_text(evil)
    name = evil.replace("/", "_")[:60]
    (world.outputs / RUN / "pictures" / f"frame_1_{name}.png").write_bytes(
        (world.outputs / RUN / "pictures" / "frame_0_abc.png").read_bytes()
    )
    (world.reports / "results" / f"{name}.json").write_text("{}")
    exported = world.reports.parent / "exported.html"
    export_dashboard(world.reports, world.outputs, exported)
    pages = [exported.read_text()]
    for base in serve(world):
        for place in ("/", "/sweep/epsilon_mini", f"/run/{RUN}", f"/run/{RUN}?against={World.run_id(2, 0)}",
                      f"/run/{RUN}?against={quote(evil)}", f"/sweep/{quote(evil, safe='')}"):  # fmt: skip
            pages.append(get(base + place)[1].decode())
    own = {tag: asset(f"{tag}.{kind}") for tag, kind in (("script", "js"), ("style", "css"))}
    shown = 0
    for page in pages:
        found = Elements()
        found.feed(page)
        assert not found.obeyed, found.obeyed
        assert set(map(str.strip, found.inside["script"])) <= {own["script"].strip(), ""}
        shown += any(evil in text for text in found.texts)
    assert shown >= 3  # in the overview, on both pages


class Elements(HTMLParser):
    """What of a page a browser would obey beyond what the templates say."""

    def __init__(self):
        super().__init__()
        self.obeyed, self.texts, self.inside, self.open = [], [], {"script": []}, None

    def handle_starttag(self, tag, attributes):
        self.open = tag
        for name, value in attributes:
            if name.startswith("on") or name in ("srcdoc", "autofocus") or (tag == "img" and value == "x"):
                self.obeyed.append((tag, name, value))
            if name in ("href", "src", "action", "formaction") and (value or "").strip().lower().startswith(
                "javascript"
            ):
                self.obeyed.append((tag, name, value))

    def handle_endtag(self, tag):
        self.open = None

    def handle_data(self, data):
        if self.open in self.inside:
            self.inside[self.open].append(data)
        else:
            self.texts.append(data)


def test_the_mark_moves_when_something_changed(world):
    for base in serve(world):
        mark = get(f"{base}/mark")[1]
        assert get(f"{base}/mark")[1] == mark
        assert mark in get(base)[1]
        path = world.reports / "results" / f"{RUN}.json"
        path.write_text(path.read_text().replace('"seed": 0', '"seed": 5'))
        assert get(f"{base}/mark")[1] != mark


def test_one_broken_sweep_leaves_the_other_pages(world, monkeypatch, caplog):
    """Whatever fails, wherever: the overview lists it, its page says it, every other page is as it was."""
    other = epsilon("mini")
    other.sweep.name = "other"
    write_record(record_path(world.reports, "other", "mini"), other)
    original = render_module.headline

    def headline(sweep):
        if sweep.record.name == "epsilon":
            raise ZeroDivisionError("no <rows>")
        return original(sweep)

    def sweep_figures(board, sweep, original=render_module.sweep_figures):
        headline(sweep)
        return original(board, sweep)

    monkeypatch.setattr(render_module, "headline", headline)
    monkeypatch.setattr(render_module, "sweep_figures", sweep_figures)
    for base in serve(world):
        status, text, _ = get(base)
        assert status == 200 and b"/sweep/other_mini" in text and RUN.encode() in text
        assert b"sweeps/epsilon_mini.json" in text and b"ZeroDivisionError: no &lt;rows&gt;" in text
        status, text, _ = get(f"{base}/sweep/epsilon_mini")
        assert status == 200 and b"This cannot be shown: ZeroDivisionError" in text
        assert b"cannot be shown" not in get(f"{base}/sweep/other_mini")[1] + get(f"{base}/run/{RUN}")[1]
    assert "no <rows>" in caplog.text


def test_without_run_folders_pages_say_what_is_missing(world):
    for base in serve(World(world.reports, world.outputs.parent / "elsewhere")):
        assert b"paths.outputs" in get(base)[1]
        text = get(f"{base}/run/{RUN}")[1]
        assert b"Pictures and the log lie in" in text and b"30.0" in text and b"margin_m = 0.8" in text
        assert b"not here" in get(f"{base}/sweep/epsilon_mini")[1]


def test_an_empty_place_is_a_page(tmp_path):
    for base in serve(World(tmp_path / "reports", tmp_path / "outputs")):
        status, text, _ = get(base)
        assert status == 200 and b"There is no reports folder yet" in text


def test_odd_names_in_records_stay_addresses(world):
    path = world.reports / "sweeps" / "epsilon_mini.json"
    text = path.read_text().replace('"name": "epsilon"', '"name": "eps \\"<b>?#&/.."', 1)
    path.write_text(text)
    for base in serve(world):
        assert get(base)[0] == 200
        assert get(f"{base}/sweep/{quote('eps ', safe='')}")[0] == 404
