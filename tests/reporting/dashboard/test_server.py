"""The live dashboard over HTTP: pages, pictures, what it refuses."""

import http.client
import urllib.error
import urllib.request
from urllib.parse import quote, urlsplit

import pytest
from experiments import World, epsilon, serve

from src.reporting.dashboard import render as render_module
from src.reporting.sweep_record import record_path, write_record


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
     "/run/horizon3d-phase1-mini-99999999", "/sweep/nothing_mini", "/templates/style.css", "/docs"],
)  # fmt: skip
def test_what_is_not_listed_is_not_there(served, path):
    status, content = raw(served, "GET", path)
    assert status == 404 and b"secret" not in content


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "", "0.0.0.0"])
def test_other_names_of_this_machine_are_refused(served, host):
    assert raw(served, "GET", "/", host)[0] == 400
    assert raw(served, "GET", f"/pictures/{RUN}/frame_0_abc.png", host)[0] == 400


def test_names_of_this_machine_are_served(served):
    assert raw(served, "GET", "/", "localhost:1234")[0] == raw(served, "GET", "/", "127.0.0.1")[0] == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
def test_nothing_can_be_changed(served, method):
    assert raw(served, method, f"/run/{RUN}")[0] == 405


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
