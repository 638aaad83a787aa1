"""The gateway as a program: its port, TLS, shutdown, and the options of `ladarreg serve`."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import ssl
import stat
import subprocess
import sys
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode
from ladarreg.gateway.options import GatewayOptions
from ladarreg.gateway.server import Gateway, exposure_warning
from ladarreg.gateway.viser_backend import close_server, open_locked_server

from ladarreg_core.errors import OptionError
from ladarreg_core.simulate import sample_folder
from testing.workbench.gateway_driver import TOKEN, Running, closing_code, hear, running, soon
from testing.workbench.processes import restore_stop_signals


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A self-signed certificate for 127.0.0.1, and its key."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    folder = tmp_path_factory.mktemp("tls")
    paths = folder / "certificate.pem", folder / "key.pem"
    words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=IP:127.0.0.1"
    subprocess.run(
        ["openssl", *words.split(), "-out", paths[0], "-keyout", paths[1]], check=True, capture_output=True, timeout=60
    )
    return paths


def started(folder: Path, *words: str) -> tuple[subprocess.Popen[str], str]:
    """Start the program, and return its process and the printed address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "testing.workbench.gateway_process", str(folder), *words],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=restore_stop_signals,
    )
    assert process.stdout is not None
    return process, process.stdout.readline().split()[1]


def at(address: str) -> Running:
    """Return the gateway of another process."""

    class There:
        port = urlsplit(address).port

    return Running(None, There)  # type: ignore[arg-type]


# --- the port --------------------------------------------------------------------------------------------------------


def test_a_busy_port_is_replaced_by_the_next(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with running(tmp_path, port=port) as run:
            assert port < run.port <= port + 100
            assert run.ask("GET", "/")[0] == 200


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.name.invalid", "not a name"])
def test_an_address_of_another_machine_is_refused(host: str) -> None:
    with pytest.raises(OptionError, match="--host"):
        Gateway(lambda port: None, GatewayOptions(host=host, port=0))  # type: ignore[arg-type, return-value]


def test_it_listens_only_on_its_address(tmp_path: Path) -> None:
    with running(tmp_path) as run, socket.socket() as other:
        other.bind(("127.0.0.2", run.port))  # free: the gateway did not take every address
        assert run.gateway.address == f"http://127.0.0.1:{run.port}/"


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
def test_it_can_listen_on_ipv6(tmp_path: Path) -> None:
    gateway = Gateway(lambda port: None, GatewayOptions(host="[::1]", port=0))  # type: ignore[arg-type, return-value]
    assert gateway.address == f"http://[::1]:{gateway.port}/"
    gateway.close()


@pytest.mark.skipif(sys.platform == "win32", reason="no Unix sockets there")
def test_it_can_listen_on_a_unix_socket(tmp_path: Path) -> None:
    path = tmp_path / "room.sock"
    with socket.socket(socket.AF_UNIX) as left:  # by a killed program
        left.bind(str(path))
    with running(tmp_path, socket=path, allowed_hosts=("scans.example",)) as run:
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        assert run.gateway.address == "https://scans.example/"
        said = {"X-Forwarded-Proto": "https", "X-Forwarded-For": "5.6.7.8", "X-Forwarded-Host": "scans.example"}
        status, headers, _ = run.ask("GET", f"/?token={TOKEN}", said, known=False)
        assert (status, "secure" in headers["set-cookie"].lower()) == (200, True), "the proxy's headers are trusted"
        with run.socket(headers=said | {"Origin": "https://scans.example"}) as page:
            assert "slices" in hear(page)
            assert run.bench.pages[-1].visitor.address == "5.6.7.8"
        with pytest.raises(OptionError, match="another program listens there"):
            Gateway(lambda port: None, GatewayOptions(socket=path))  # type: ignore[arg-type, return-value]
        assert path.is_socket(), "the other program's is not removed"
    assert not path.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no Unix sockets there")
def test_a_path_that_cannot_be_listened_on_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"precious")
    for path, reason in ((tmp_path / "file", "not a socket"), (tmp_path / "none" / "a.sock", "No such file")):
        with pytest.raises(OptionError, match=f"{reason}.*--socket"):
            Gateway(lambda port: None, GatewayOptions(socket=path))  # type: ignore[arg-type, return-value]
    assert (tmp_path / "file").read_bytes() == b"precious"
    with pytest.raises(OptionError, match="--certfile"):
        GatewayOptions(socket=tmp_path / "a.sock", certfile="x")


def test_listening_beyond_loopback_is_warned_of() -> None:
    assert "TLS" in exposure_warning(GatewayOptions(host="0.0.0.0"))
    assert "token" in exposure_warning(GatewayOptions(host="0.0.0.0", certfile="x"))


# --- TLS -------------------------------------------------------------------------------------------------------------


def test_with_a_certificate_everything_is_tls(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    trust = ssl.create_default_context(cafile=str(certificate[0]))
    files = {"certfile": str(certificate[0]), "keyfile": str(certificate[1])}
    server, address = open_locked_server(label="tls")
    try:
        with running(tmp_path, address, context=trust, allowed_hosts=("scans.example",), **files) as run:
            status, headers, _ = run.ask("GET", f"/?token={TOKEN}", {"Host": "scans.example"}, known=False)
            assert status == 200
            assert "secure" in headers["set-cookie"].lower().split("; ")
            assert headers["strict-transport-security"].startswith("max-age=")
            assert "strict-transport-security" not in run.ask("GET", "/", {"Host": "localhost"})[1]
            assert run.gateway.address.startswith("https://")
            assert "slices" in json.loads(run.first_message("/document"))
            assert run.first_message("/viser", subprotocols=["viser-v1.1.1"])
            with socket.create_connection(("127.0.0.1", run.port), timeout=60) as plain:
                plain.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
                with contextlib.suppress(ConnectionError):  # a reset refuses it as well as an alert or a close
                    assert not plain.recv(100).startswith(b"HTTP/1.1 200")
    finally:
        close_server(server)


def test_a_certificate_that_cannot_be_used_is_refused(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    words = tmp_path / "words.pem"
    words.write_text("no certificate")
    locked_key = tmp_path / "locked.pem"
    subprocess.run(
        ["openssl", "rsa", "-aes256", "-passout", "pass:four", "-in", certificate[1], "-out", locked_key],
        check=True,
        capture_output=True,
        timeout=60,
    )
    for certfile, keyfile in (
        (words, certificate[1]), (certificate[0], words), (tmp_path / "none.pem", None), (certificate[0], None),
        (certificate[0], locked_key),
    ):  # fmt: skip
        options = GatewayOptions(port=0, certfile=str(certfile), keyfile=keyfile and str(keyfile))
        with pytest.raises(OptionError, match="certificate"):
            Gateway(lambda port: None, options)  # type: ignore[arg-type, return-value]


# --- its end ---------------------------------------------------------------------------------------------------------


def test_closing_notifies_the_clients_and_frees_the_port(tmp_path: Path) -> None:
    with running(tmp_path) as run:
        port, page = run.port, run.socket()
        hear(page)
        codes: list[int] = []
        listener = threading.Thread(target=lambda: codes.append(closing_code(page)))
        listener.start()
        run.gateway.close()
        listener.join(timeout=60)
        assert codes == [1012]
        assert soon(lambda: not run.bench.pages)
        with socket.socket() as again:
            again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            again.bind(("127.0.0.1", port))


def begin_upload(there: Running) -> socket.socket:
    """Start an upload that is never completed."""
    line = socket.create_connection(("127.0.0.1", there.port), timeout=60)
    head = (
        f"POST {there.access.within('/upload?what=scan')} HTTP/1.1\r\nHost: localhost\r\n"
        f"Origin: http://localhost\r\nCookie: {there.access.cookie}\r\n"
    )
    line.sendall(f"{head}X-File-Name: a.e57\r\nContent-Length: 100000\r\n\r\nabc".encode())
    return line


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals differ there")
@pytest.mark.parametrize(("sent", "uploads"), [(signal.SIGINT, 1), (signal.SIGTERM, 0)])
def test_ctrl_c_ends_it_quietly_with_clients_connected(tmp_path: Path, sent: signal.Signals, uploads: int) -> None:
    process, address = started(tmp_path)
    try:
        there = at(address)
        assert address == f"http://127.0.0.1:{there.port}/?token={TOKEN}"
        there.enter()
        with there.socket() as page, there.socket("/viser", subprotocols=["viser-v1.1.1"]) as view:
            hear(page)
            view.recv(timeout=60)
            lines = [begin_upload(there) for _ in range(uploads)]
            assert soon(lambda: len(list(tmp_path.iterdir())) == uploads)
            process.send_signal(sent)
            assert closing_code(page) == 1012
        _, said = process.communicate(timeout=60)
        for line in lines:
            line.close()
    finally:
        process.kill()
    assert process.returncode == 0
    assert not said.strip()
    assert not list(tmp_path.iterdir()), "the upload that was under way left nothing"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals differ there")
def test_the_command_serves_a_scan_and_a_photograph(tmp_path: Path) -> None:
    inputs = sample_folder()
    words = ["serve", "--no-browser", "--port", "0", "--project", str(tmp_path / "project")]
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", *words, str(inputs / "scan.npz"), str(inputs / "photo.png")],
        cwd=Path(__file__).parents[3],
        env=os.environ | {"LADARREG_TOKEN": TOKEN},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=restore_stop_signals,
    )
    try:
        assert process.stdout is not None
        there = at(process.stdout.readline().split()[1])
        there.enter()
        with there.socket() as page, there.socket("/viser", subprotocols=["viser-v1.1.1"]) as view:
            slices = hear(page)["slices"]
            assert slices["scan"]["name"]
            assert [photo["name"] for photo in slices["photos"]] == ["photo.png"]
            assert isinstance(view.recv(timeout=60), bytes)
            status, headers, _ = there.ask("GET", f"/picture/photo/{slices['photos'][0]['id']}?rev=1")
            assert (status, headers["content-type"].partition("/")[0]) == (200, "image")
            assert there.ask("GET", "/picture/photo/none")[0] in (400, 404)
            process.send_signal(signal.SIGINT)
            assert closing_code(page) == 1012
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    assert "Traceback" not in said


# --- the words -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ["--port", "70000"], ["--port", "-1"], ["--token", "short"], ["--token", ""], ["--keyfile", "key.pem"],
        ["--certfile", "no.pem"], ["--upload-limit-mb", "0"], ["--folder", "no-such-folder"], ["--port", "x"],
        ["--allow-host", "https://scans.example"], ["--allow-host", "scans.example:80"],
    ],
)  # fmt: skip
def test_wrong_options_give_one_line_before_anything_is_opened(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", "--no-browser", *words]) == ExitCode.BAD_INPUT
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith("ladarreg: ")


def test_a_short_token_in_the_environment_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LADARREG_TOKEN", "short")
    assert main(["serve", "--no-browser"]) == ExitCode.BAD_INPUT
    said = capsys.readouterr().err
    assert "at least 22" in said
    assert "secrets.token_urlsafe()" in said
