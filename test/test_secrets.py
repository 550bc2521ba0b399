"""What may be a secret of a camera's address is shown nowhere; text that is no address stays as it is."""

from __future__ import annotations

import os
from typing import Any

import cv2
import pytest

from yolov5_lifecycle.printable import in_lines, in_one_line, without_secrets
from yolov5_lifecycle.process.standard_streams import complain
from yolov5_lifecycle.settings.value_text import shown_value
from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.network_stream import open_capture
from yolov5_lifecycle.sources.source import open_source

FFMPEG = pytest.mark.skipif(
    not cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG), reason="OpenCV without FFmpeg"
)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        pytest.param("rtsp://a:b@h/x", "rtsp://***@h/x", id="password"),
        pytest.param("rtsp://me@mail.com:secret@h/x", "rtsp://***@h/x", id="e-mail address"),
        pytest.param("rtsp://me@h/x@y", "rtsp://***@h/x@y", id="user alone"),
        pytest.param("rtsp://a:b@c@h/x", "rtsp://***@h/x", id="@ in the password"),
        pytest.param("rtsp://a:b/c@h/x", "rtsp://***@h/x", id="slash in the password"),
        pytest.param("rtsp://a/b:c@h/x", "rtsp://***@h/x", id="slash in the user name"),
        pytest.param("rtsp://a:b c@h/x", "rtsp://***@h/x", id="blank in the password"),
        pytest.param("rtsp://a:b?c=d#e@h/x?f=g", "rtsp://***@h/x?f=***", id="query in the password"),
        pytest.param("rtsp://h:554/x@y", "rtsp://***@y", id="ambiguous"),
        pytest.param("rtsp://h/x?pwd=a&b=c/d=&e", "rtsp://h/x?pwd=***&b=***&***", id="query"),
        pytest.param("rtsp://h/x?pwd=a b", "rtsp://h/x?pwd=***", id="blank in the query"),
        pytest.param("rtsp://h:1/?a=me@mail.com&b=c", "rtsp://***@mail.com&b=***", id="@ in the query"),
        pytest.param("rtsp://h/user=a_password=b_c.sdp?d", "rtsp://h/user=***", id="values in the path"),
        pytest.param(
            "rtspsrc location=rtsp://a:b@h/x user-pw = 'c d' proxy-pw=e ! appsink",
            "rtspsrc location=rtsp://***@h/x user-pw = *** proxy-pw=*** ! appsink",
            id="pipeline",
        ),
        pytest.param("To srt://h:1?passphrase=a failed", "To srt://h:1?passphrase=*** failed", id="message"),
        pytest.param(
            "http://h/n.pt: answers 404 ?why", "http://h/n.pt: answers 404 ?why", id="before a message"
        ),
        pytest.param(
            "rtsp://a:b: c@h/x: no", "rtsp://***@h/x: no", id="blank in the password, and a message"
        ),
        pytest.param("x:rtsp://a:b c@h/x, rtsp://d@i", "x:rtsp://***@h/x, rtsp://***@i", id="two"),
        pytest.param("'rtsp://h:1/x?a=b' me@x", "'rtsp://h:1/x?a=***' me@x", id="quoted"),
    ],
)
def test_secrets_of_an_address_are_not_shown(text: str, shown: str) -> None:
    assert in_one_line(text) == shown
    assert in_lines(f"one\n  {shown}") == f"one\n  {shown}"  # shown again, it stays as it is


@pytest.mark.parametrize(
    "text",
    [
        "rtsp://h:554/x",
        "https://medium.com/@user/x",
        "file:///a/b.yaml and package://c/d",
        "a:b@c a=b ?c=d",
        "Done ! a-b",
    ],
)
def test_text_without_an_address_with_secrets_stays(text: str) -> None:
    assert in_one_line(text) == text


@pytest.mark.parametrize("text", ["a://b:c", " a://", "'a://b:", "a" * 40 + "://", ' ! a="', "a://b:c @ "])
def test_hostile_text_is_shown_before_a_cost_with_the_square_of_its_length_would_end(text: str) -> None:
    assert without_secrets((text * 300_000)[:300_000])


def test_a_line_of_an_error_and_a_wrong_value_have_no_secrets(capsys: pytest.CaptureFixture[str]) -> None:
    complain("camera", "failed\n  at rtsp://a:secret@h")
    assert capsys.readouterr().err == "camera: failed\n  at rtsp://***@h\n"
    assert shown_value(f"rtsp://a:{'secret' * 20}@h") == "'rtsp://***@h'"


@FFMPEG
def test_what_opencv_prints_has_no_secrets(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def capture(source: str, *_: Any) -> None:
        os.write(2, f"no {source}\nnor \udcff {source}".encode(errors="surrogateescape"))

    monkeypatch.setattr(cv2, "VideoCapture", capture)
    open_capture("rtsp://a:secret@h/x")
    os.write(2, b"end")
    assert capfd.readouterr().err == "no rtsp://***@h/x\nnor \ufffd rtsp://***@h/x\nend"


@pytest.mark.parametrize("source", ["rtsp://a:b/c@h/x", "rtsp://a:b#c@h/x", "rtsp://a:b c@h/x"])
def test_a_part_of_a_password_is_not_asked_for_as_a_host(source: str) -> None:
    with pytest.raises(
        SourceError, match=r"'rtsp://\*\*\*@h/x': expected HOST or HOST:PORT .* Percent-encode"
    ):
        open_source(source)


@pytest.mark.parametrize("source", ["a:secret@h/x", "rtsp:/a:secret@h/x"])
def test_an_address_without_its_scheme_shows_no_password(source: str) -> None:
    with pytest.raises(SourceError, match=r"^'\*\*\*@h/x' is neither"):
        open_source(source)
