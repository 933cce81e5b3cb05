"""The server of `lslam view`: who is answered, what is given, what is written."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lslam.core.errors import UsageError
from lslam.pipeline.view.server import MOST_BODY, Answer, RunServer, Site

Reply = tuple[int, http.client.HTTPMessage, bytes]
Ask = Callable[..., Reply]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[RunServer]:
    """A folder with a page, a table, a script that somebody laid there, and links; beside it a secret."""
    run = tmp_path / "run"
    (run / "inner").mkdir(parents=True)
    (run / "loops.csv").write_text("a,b\n")
    (run / "evil.html").write_text("<script>1</script>")
    (run / "inner" / "deep.json").write_text("{}")
    (tmp_path / "secret.txt").write_text("secret")
    (tmp_path / "run-other").mkdir()
    (tmp_path / "run-other" / "secret.txt").write_text("secret")
    (run / "out").symlink_to(tmp_path / "secret.txt")
    (run / "up").symlink_to(tmp_path)
    (run / "within").symlink_to(run / "loops.csv")
    (run / "round").symlink_to(run / "round")
    with RunServer() as server:
        noted: list[Any] = []
        server.noted = noted  # type: ignore[attr-defined]
        for name in ("first", "second"):
            server.sites.append(
                Site(
                    run,
                    lambda name=name: Answer("text/html", name.encode()),
                    gets={"api/edits": lambda words: {"words": words}, "api/fails": lambda words: 1 / 0},
                    posts={"api/edits": lambda document: noted.append(document) or {"count": len(noted)}},
                    node={"r": b"\x01\x02", "r7": b"\x03"}.get,
                )
            )
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def ask(served: RunServer) -> Ask:
    def request(path: str, method: str = "GET", body: Any = None, token: str = "", **headers: str) -> Reply:
        connection = http.client.HTTPConnection("127.0.0.1", served.server_port, timeout=10)
        names = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, f"/{token or served.token}{path}", body, names)
        reply = connection.getresponse()
        content = reply.read()
        connection.close()
        return reply.status, reply.headers, content

    return request


def test_it_listens_on_this_machine_alone(served: RunServer) -> None:
    assert served.server_address[0] == "127.0.0.1"
    with socket.socket(socket.AF_INET6) as six:
        six.settimeout(2)
        assert six.connect_ex(("::1", served.server_port)) != 0
    # Linux answers on all of 127.0.0.0/8 whatever is bound to 0.0.0.0.
    with socket.socket() as four:
        four.settimeout(2)
        assert four.connect_ex(("127.0.0.2", served.server_port)) != 0


def test_pages_tables_and_tiles_are_given(ask: Ask) -> None:
    status, headers, body = ask("/")
    assert (status, body, headers["Content-Type"]) == (200, b"first", "text/html")
    assert (headers["X-Content-Type-Options"], headers["Cache-Control"]) == ("nosniff", "no-store")
    assert headers["Referrer-Policy"] == "no-referrer", "the address has the token in it"
    assert ask("/1/")[2] == b"second"
    assert ask("/loops.csv")[2] == ask("/within")[2] == b"a,b\n"
    assert ask("/loops.csv")[1]["Content-Type"] == "text/csv"
    assert ask("/inner/deep.json")[2] == b"{}"
    assert ask("/tiles/r7.bin")[2] == b"\x03"
    assert json.loads(ask("/api/edits?a=1&b=%3C")[2]) == {"words": {"a": "1", "b": "<"}}
    status, headers, body = ask("/loops.csv", "HEAD")
    assert (status, headers["Content-Length"], body) == (200, "4", b"")


def test_a_page_that_somebody_laid_there_runs_no_script(ask: Ask) -> None:
    _, headers, _ = ask("/evil.html")
    assert headers["Content-Type"] == "application/octet-stream"
    assert headers["Content-Disposition"] == "attachment"
    assert headers["Content-Security-Policy"] == "sandbox"


@pytest.mark.parametrize(
    "path",
    [
        "/../secret.txt", "/..%2fsecret.txt", "/%2e%2e/secret.txt", "/%2e%2e%2fsecret.txt", "/inner/../../secret.txt",
        "/..%2frun-other/secret.txt", "/out", "/up/secret.txt", "/round", "//etc/passwd", "/%2fetc%2fpasswd", "/inner",
        "/a%00b", "/..%5csecret.txt", "/%252e%252e/secret.txt", "/tiles/r9.bin", "/tiles/../../secret.txt", "/2/", "/none",
    ],
)  # fmt: skip
def test_nothing_outside_the_run_folder_is_given(ask: Ask, path: str) -> None:
    status, _, body = ask(path)
    assert (status, b"secret" in body, b"root" in body) == (404, False, False)


def test_without_its_token_nothing_is_given(ask: Ask, served: RunServer) -> None:
    assert len(served.token) >= 30
    for token in ("x", served.token[:-1], served.token + "x", "%ff", served.token.upper()):
        status, _, body = ask("/loops.csv", token=token)
        assert status in (400, 403)
        assert served.token.encode() not in body
    connection = http.client.HTTPConnection("127.0.0.1", served.server_port, timeout=10)
    connection.request("GET", "/")
    assert connection.getresponse().status == 403
    with RunServer() as other:
        assert other.token != served.token


def test_names_that_lead_here_and_pages_of_others_are_refused(ask: Ask, served: RunServer) -> None:
    port = served.server_port
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"LOCALHOST:{port}"):
        assert ask("/", Host=host)[0] == 200
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}", ""):
        assert ask("/", Host=host)[0] == 403
    post = {"method": "POST", "body": "{}", "Content_Type": "application/json"}
    for origin in (f"http://127.0.0.1:{port}", f"http://localhost:{port}"):
        assert ask("/", Origin=origin)[0] == 200
        assert ask("/api/edits", **post, Origin=origin)[0] == 200
    before = list(served.noted)  # type: ignore[attr-defined]
    for origin in ("http://evil.example", "null", f"https://127.0.0.1:{port}", f"http://127.0.0.1:{port + 1}"):
        assert ask("/", Origin=origin)[0] == 403
        assert ask("/api/edits", **post, Origin=origin)[0] == 403
    assert served.noted == before  # type: ignore[attr-defined]


def test_only_the_api_takes_what_is_sent_and_not_too_much(ask: Ask, served: RunServer) -> None:
    json_kind = {"Content_Type": "application/json"}
    assert json.loads(ask("/api/edits", "POST", '{"pairs": []}', **json_kind)[2]) == {"count": 1}
    noted = served.noted  # type: ignore[attr-defined]
    assert noted == [{"pairs": []}]
    assert ask("/loops.csv", "POST", "{}", **json_kind)[0] == 404
    assert ask("/api/fails", "POST", "{}", **json_kind)[0] == 405
    for method in ("PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"):
        status, headers, body = ask("/loops.csv", method)
        assert (status, headers["Content-Type"], headers["Allow"]) == (405, "application/json", "GET, HEAD, POST")
        assert json.loads(body) == {"error": "Method Not Allowed"}
    assert ask("/api/edits", "POST", "{}", Content_Type="text/plain")[0] == 415, "a form of another page sends this"
    assert ask("/api/edits", "POST", "{", **json_kind)[0] == 400
    assert ask("/api/edits", "POST", "[" * 100_000, **json_kind)[0] == 400
    assert ask("/api/edits", "POST", "{}", Content_Length="two", **json_kind)[0] == 400
    assert ask("/api/edits", "POST", Transfer_Encoding="chunked", **json_kind)[0] == 411, "of no size that is known"
    assert ask("/api/edits", "POST", b"{}", Content_Length=str(MOST_BODY + 1), **json_kind)[0] == 413
    assert noted == [{"pairs": []}]


def test_a_mistake_is_a_sentence_and_the_server_goes_on(ask: Ask, served: RunServer) -> None:
    status, _, body = ask("/api/fails")
    assert (status, "ZeroDivisionError" in json.loads(body)["error"]) == (500, True)

    def refuses(words: object) -> None:
        raise UsageError("scan 5 is none of the run's")

    served.sites[0].gets["api/pair"] = refuses  # type: ignore[index]
    assert (ask("/api/pair")[0], json.loads(ask("/api/pair")[2])) == (422, {"error": "scan 5 is none of the run's"})
    assert ask("/")[0] == 200


def test_a_port_in_use_is_said(served: RunServer) -> None:
    with pytest.raises(UsageError, match=f"--port {served.server_port} cannot be used: .*leave it out"):
        RunServer(served.server_port)
