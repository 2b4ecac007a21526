"""The decoding process: the same bits as without it, and whatever it does, the worker gets an answer."""

from __future__ import annotations

import errno
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from intrasplat.clip import ClipLimits, DepthClip, open_clip
from intrasplat.clip.calibration import load_calibration, rectify
from intrasplat.decode import StereoRecording, decode_clip
from intrasplat.decode.contained import DecoderKilledError, Patience, keep_decoder_ready
from intrasplat.decode.guard import PROTECTIONS, Allowance
from intrasplat.errors import Cancelled, InputError, LimitError
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.notices import NoticeCode
from intrasplat.stereo import estimate_depth
from tests.intrasplat.clip.conftest import Studio
from tests.intrasplat.clip.recorder import damaged, record
from tests.intrasplat.decode.stand_in import run_stand_in

CALIBRATION = (
    '{"model": "rectified", "width": 96, "height": 80, "fx_px": 90, "fy_px": 90, "cx_px": 48, "cy_px": 40, '
    '"baseline_mm": 4}'
)
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel's protections are Linux's")


@pytest.fixture
def studio(tmp_path: Path) -> Studio:
    return Studio(tmp_path)


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where decoded frames lie for a while."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def calibrated(studio: Studio) -> Path:
    path = studio.root / "calibration.json"
    path.write_text(CALIBRATION)
    return path


def side_by_side(studio: Studio) -> Path:
    return studio.video("clip.webm", np.concatenate(studio.eyes(), axis=2))


def assert_same(actual: Any, expected: Any) -> None:
    np.testing.assert_array_equal(np.asarray(actual), np.asarray(expected))


def test_a_stereo_clip_comes_out_of_the_process_bit_for_bit(studio: Studio, scratch: Path) -> None:
    clip, calibration = side_by_side(studio), calibrated(studio)
    masks = studio.masks("masks", studio.tool())
    expected = open_clip(clip, masks=masks)
    assert not isinstance(expected, DepthClip)
    decoded = decode_clip(clip, calibration=calibration, masks=masks)
    assert isinstance(decoded, StereoRecording)
    for pair, other in zip(decoded.clip.pairs(), expected.pairs(), strict=True):
        assert_same(pair[0], other[0])
        assert_same(pair[1], other[1])
    assert_same(decoded.clip.tissue, expected.tissue)
    assert_same(decoded.clip.frame_times_s, expected.frame_times_s)
    assert decoded.clip.assumptions[:-1] == expected.assumptions
    assert decoded.clip.warnings == expected.warnings
    assert decoded.calibration == load_calibration(calibration, eye_width=96, eye_height=80)
    assert list(scratch.iterdir()) == []
    assert len(list(decoded.clip.pairs())) == 6  # what is mapped outlives its files, and can be read again


def test_damage_is_told_by_the_process(studio: Studio, scratch: Path) -> None:
    left, right = studio.eyes()
    path = scratch.parent / "clip.mp4"
    whole = record(path, np.concatenate([left, right], axis=2), keyframes=3, options={"bf": "0"})
    decoded = decode_clip(damaged(whole, 4), calibration=calibrated(studio))
    assert isinstance(decoded, StereoRecording)
    assert decoded.clip.damaged == (4, 5)
    assert decoded.clip.warnings[0].code is NoticeCode.DAMAGED_FRAMES
    assert len(list(decoded.clip.pairs())) == 6


def test_a_clip_is_there_before_its_frames_and_their_error_when_they_are_read(studio: Studio, scratch: Path) -> None:
    for eye, frames in zip(("left", "right"), studio.eyes(), strict=True):
        studio.images(f"clip/{eye}/{{}}.png", frames)
    (studio.root / "clip/calibration.json").write_text(CALIBRATION)
    last = max((studio.root / "clip/right").iterdir())
    last.write_bytes(last.read_bytes()[:200] + last.read_bytes()[-100:])
    decoded = decode_clip(studio.root / "clip")
    assert isinstance(decoded, StereoRecording)
    with pytest.raises(InputError, match="damaged"):
        list(decoded.clip.pairs())
    assert list(scratch.iterdir()) == []


def test_a_recording_that_nobody_reads_ends_its_process(studio: Studio, scratch: Path) -> None:
    decode_clip(side_by_side(studio), calibration=calibrated(studio))
    assert list(scratch.iterdir()) == []


def test_a_process_that_was_started_ahead_reads_one_clip(studio: Studio, scratch: Path) -> None:
    keep_decoder_ready()
    keep_decoder_ready()
    (waiting,) = scratch.iterdir()
    clip, calibration = side_by_side(studio), calibrated(studio)
    first = decode_clip(clip, calibration=calibration)
    assert list(scratch.iterdir()) == [waiting]
    second = decode_clip(clip, calibration=calibration)
    assert len(list(scratch.iterdir())) == 2
    for decoded in (first, second):
        assert isinstance(decoded, StereoRecording)
        assert len(list(decoded.clip.pairs())) == 6
    assert list(scratch.iterdir()) == []


def test_masks_of_both_eyes_come_out_of_the_process(studio: Studio, scratch: Path) -> None:
    tool = studio.tool()
    packed = studio.masks("masks", np.concatenate([tool, tool[:, ::-1]], axis=2))
    decoded = decode_clip(side_by_side(studio), calibration=calibrated(studio), masks=packed)
    assert isinstance(decoded, StereoRecording)
    assert_same(decoded.clip.tissue, ~tool)
    assert_same(decoded.clip.tissue_right, ~tool[:, ::-1])
    eyes = estimate_depth(rectify(decoded.clip, decoded.calibration)).eyes
    assert_same(eyes[1].tissue, ~tool[:, ::-1])
    assert "masks of the right eye: as given" in [each.text for each in decoded.clip.assumptions]
    assert list(scratch.iterdir()) == []


def test_a_clip_with_depth_comes_out_of_the_process_bit_for_bit(studio: Studio, scratch: Path) -> None:
    folder = studio.endonerf()
    expected, decoded = open_clip(folder), decode_clip(studio.zip(folder))
    assert isinstance(expected, DepthClip)
    assert isinstance(decoded, DepthClip)
    for name, array in vars(expected).items():
        if isinstance(array, np.ndarray):
            assert_same(getattr(decoded, name), array)
            assert getattr(decoded, name).dtype == array.dtype
    assert decoded.intrinsics == expected.intrinsics
    assert list(scratch.iterdir()) == []


def test_a_folder_may_link_to_where_its_frames_lie(studio: Studio) -> None:
    folder = studio.endonerf()
    (folder / "images").rename(studio.root / "elsewhere")
    (folder / "images").symlink_to(studio.root / "elsewhere")
    mask = next((folder / "masks").iterdir())
    mask.rename(studio.root / "mask.png")
    mask.symlink_to("../../mask.png")
    decoded = decode_clip(folder)
    assert isinstance(decoded, DepthClip)
    expected = open_clip(folder)
    assert isinstance(expected, DepthClip)
    assert_same(decoded.rgb, expected.rgb)


def test_a_calibration_inside_the_clips_zip_is_found(studio: Studio) -> None:
    left, right = studio.eyes()
    studio.images("clip/left/{}.png", left)
    studio.images("clip/right/{}.png", right)
    (studio.root / "clip/calibration.json").write_text(CALIBRATION)
    decoded = decode_clip(studio.zip(studio.root / "clip"))
    assert isinstance(decoded, StereoRecording)
    assert decoded.calibration.width == 96


def test_a_stereo_clip_without_a_calibration_says_that_it_needs_one(studio: Studio) -> None:
    with pytest.raises(InputError, match="none was given") as caught:
        decode_clip(side_by_side(studio))
    assert caught.value.field == "calibration"


def test_what_is_found_wrong_in_the_process_is_told_as_it_is_outside(studio: Studio, scratch: Path) -> None:
    clip = side_by_side(studio)
    with pytest.raises(LimitError, match="the limit is 3") as caught:
        decode_clip(clip, calibration=calibrated(studio), limits=ClipLimits(frames=3))
    assert caught.value.field == "clip"
    assert caught.value.remedy == "Cut a shorter clip."
    assert list(scratch.iterdir()) == []


def test_frames_are_reported_as_they_are_decoded(studio: Studio) -> None:
    seen: list[Progress] = []
    decode_clip(side_by_side(studio), calibration=calibrated(studio), hooks=Hooks(on_progress=seen.append))
    shares = [progress.fraction for progress in seen]
    assert {progress.stage for progress in seen} == {"decode"}
    assert shares == sorted(shares)
    assert len(shares) >= 2


def test_a_stopped_job_ends_the_process_and_leaves_nothing(studio: Studio, scratch: Path) -> None:
    clip, calibration = side_by_side(studio), calibrated(studio)
    stop = threading.Event()
    hooks = Hooks(on_progress=lambda progress: stop.set(), should_stop=stop.is_set)
    with pytest.raises(Cancelled):
        decode_clip(clip, calibration=calibration, hooks=hooks)
    assert list(scratch.iterdir()) == []


@linux
def test_the_report_says_what_protected_the_worker(studio: Studio) -> None:
    decoded = decode_clip(studio.endonerf(), limits=ClipLimits(decoded_bytes=1 << 30))
    assert isinstance(decoded, DepthClip)
    assert decoded.assumptions[-1].text.startswith("decoding: in a process of its own (limited memory of 3.0 GiB")
    for word in PROTECTIONS:
        assert word in decoded.assumptions[-1].text  # as held, or as what the kernel did not grant


@pytest.mark.parametrize(
    ("work", "problem"),
    [
        ("import ctypes; ctypes.string_at(0)", "the decoder crashed .SIGSEGV."),
        ("import os; os.abort()", "the decoder crashed .SIGABRT."),
        ("import os; os._exit(3)", "the decoder crashed .status 3."),
        ("(folder / 'left').write_bytes(bytes(2 << 20))", "its frames take more than 1048576 bytes"),
        ("raise ValueError('a file name')", "the decoder failed .ValueError."),
        ("import os; os.write(3, b'nonsense\\n' * 9)\nimport time; time.sleep(9)", "the decoder talks nonsense"),
        ("import os; os.write(3, b'x' * (5 << 20))", "the decoder talks nonsense"),
        ("import os; os.write(3, b'[' * 100_000 + b'\\n')", "the decoder talks nonsense"),
        ('import os; os.write(3, b\'{"pictures": Infinity, "share": 0}\\n\')', "the decoder talks nonsense"),
        ("reports._send({'result': 3})", "the decoder talks nonsense"),
        ("reports.fail({'kind': 'input'})", "the decoder talks nonsense"),
    ],
)
def test_a_decoder_that_misbehaves_is_an_error_of_its_clip(tmp_path: Path, work: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        run_stand_in(tmp_path, work.replace("os.write(3", "os.write(reports._stream.fileno()"))
    assert caught.value.field == "clip"
    assert "H.264" in caught.value.remedy


def test_a_decoder_that_runs_out_of_its_memory_names_the_limit_and_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(LimitError, match=r"needed more than 1\.0 GiB of memory") as caught:
        run_stand_in(tmp_path, "bytearray(2 << 30)")
    assert caught.value.field == "clip"
    assert "container more memory" in caught.value.remedy


def test_a_decoder_that_something_killed_is_no_error_of_its_clip(tmp_path: Path) -> None:
    with pytest.raises(DecoderKilledError, match="memory runs out"):
        run_stand_in(tmp_path, "import signal; signal.raise_signal(signal.SIGKILL)")


def test_a_decoder_that_computes_without_end_is_ended(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="took more than 1 s of computing"):
        run_stand_in(tmp_path, "while True: pass", allowance=Allowance(1 << 30, 1 << 20, cpu_s=1))


def test_a_decoder_that_hangs_is_ended(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"made no progress for 0\.5 s"):
        run_stand_in(tmp_path, "import time; time.sleep(60)", patience=Patience(max_silence_s=0.5))


def test_a_decoder_that_never_ends_its_line_is_ended(tmp_path: Path) -> None:
    work = "import time\nwhile True: reports._stream.write(b' '); reports._stream.flush(); time.sleep(0.02)"
    with pytest.raises(InputError, match=r"made no progress for 0\.5 s"):
        run_stand_in(tmp_path, work, patience=Patience(max_silence_s=0.5))


def test_a_decoder_that_only_pretends_to_advance_is_ended_too(tmp_path: Path) -> None:
    work = "import time\nwhile True: reports.picture(); time.sleep(0.02)"
    with pytest.raises(InputError, match="took more than 1 s"):
        run_stand_in(tmp_path, work, patience=Patience(max_total_s=1.0))


def test_a_crash_over_the_calibration_names_the_calibration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="crashed") as caught:
        run_stand_in(tmp_path, "reports.reading('calibration')\nimport os; os.abort()")
    assert caught.value.field == "calibration"


@linux
@pytest.mark.parametrize(
    ("work", "protection"),
    [
        ("import socket; socket.create_connection(('127.0.0.1', PORT))", "no network"),
        ("import os; os.fork()", "no other program"),
        ("import os; os.execv('/bin/true', ['true'])", "no other program"),
        ("import os; os.kill(os.getppid(), 0)", "no other program"),
        ("import os, resource; resource.prlimit(os.getppid(), resource.RLIMIT_CPU)", "no other program"),
        ("import os; os.setpriority(os.PRIO_PROCESS, os.getppid(), 19)", "no other program"),
        ("import os; os.chmod('SECRET', 0o666)", "no other program"),
        ("import os; os.chown('SECRET', -1, -1)", "no other program"),
        ("import os; os.utime('SECRET', (0, 0))", "no other program"),
        ("import os; os.setxattr('SECRET', 'user.a', b'')", "no other program"),
        ("import os; os.chroot('.')", "no other program"),
        ("open('SECRET').read()", "no files but its own"),
        ("open('SECRET', 'a')", "no files but its own"),
        ("import os; os.truncate('SECRET', 0)", "no files but its own"),
        ("import os; os.listdir('/')", "no files but its own"),
        ("open(f'/proc/{__import__(\"os\").getppid()}/mem', 'r+b')", "no files but its own"),
    ],
)
def test_a_decoder_that_was_taken_over_reaches_nothing(tmp_path: Path, work: str, protection: str) -> None:
    secret = tmp_path / "secret"
    secret.write_text("another's clip")
    tried = f"try:\n    {work.replace('SECRET', str(secret)).replace('PORT', '9')}\nexcept OSError as error:\n"
    told = run_stand_in(tmp_path, tried + "    return {'refused': type(error).__name__}")
    if protection not in told["granted"]:
        pytest.skip(f"this kernel does not grant: {protection}")
    assert told["refused"] == "PermissionError"
    assert secret.read_text() == "another's clip"


@linux
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the calls' numbers are those of x86-64")
@pytest.mark.parametrize("call", ["234, parent, parent, 0", "129, parent, 0, None"])  # tgkill, rt_sigqueueinfo
def test_no_way_of_sending_a_signal_reaches_another_process(tmp_path: Path, call: str) -> None:
    work = (
        "import ctypes, os\n"
        "parent, libc = os.getppid(), ctypes.CDLL(None, use_errno=True)\n"
        f"return {{'value': libc.syscall({call}), 'errno': ctypes.get_errno()}}"
    )
    told = run_stand_in(tmp_path, work)
    if "no other program" not in told["granted"]:
        pytest.skip("this kernel does not grant: no other program")
    assert (told["value"], told["errno"]) == (-1, errno.EPERM)


@linux
def test_a_decoder_with_a_thread_that_is_not_confined_reads_nothing(tmp_path: Path) -> None:
    thread = "import threading, time; threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
    with pytest.raises(InputError, match="crashed"):
        run_stand_in(tmp_path, "", before=thread)


@linux
def test_a_decoder_of_roots_is_not_root(tmp_path: Path) -> None:
    work = (
        "import ctypes, struct\n"
        "held = ctypes.create_string_buffer(24)\n"
        "ctypes.CDLL(None).capget(struct.pack('=Ii', 0x20080522, 0), held)\n"
        "return {'capabilities': struct.unpack('=6I', held)}"
    )
    may_read_any = 1 << 2
    assert set(run_stand_in(tmp_path, work)["capabilities"]) <= {0, may_read_any}


def test_a_decoder_that_stays_after_its_answer_is_ended(tmp_path: Path) -> None:
    work = "import os, time\nreports.end({'pid': os.getpid()})\ntime.sleep(60)"
    pid = run_stand_in(tmp_path, work, patience=Patience(max_exit_s=0.3))["pid"]
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_decoder_reads_what_it_is_given_and_writes_in_its_folder(tmp_path: Path) -> None:
    given = tmp_path / "given"
    given.write_text("a clip")
    work = f"(folder / 'left').write_text(open({str(given)!r}).read())\nreturn {{'left': open('left').read()}}"
    assert run_stand_in(tmp_path, work, readable=[str(given)])["left"] == "a clip"


def test_a_decoder_gets_nothing_of_the_workers_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REDIS_URL", "redis://:secret@queue")
    work = "import os\nreturn {'names': sorted(os.environ), 'files': sorted(os.listdir('.'))}"
    told = run_stand_in(tmp_path, work)
    assert "REDIS_URL" not in told["names"]
    assert told["files"] == []


@linux
def test_a_decoder_ends_with_its_worker(tmp_path: Path) -> None:
    """The kernel kills it as soon as its parent is gone, however that went."""
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, threading, time\n"
        "from pathlib import Path\n"
        "from tests.intrasplat.decode.test_decode import run_stand_in\n"
        "work = 'import time, os\\n' 'while True: (folder / \"beat\").write_text(str(time.time())); time.sleep(0.02)'\n"
        f"folder = Path({str(tmp_path)!r})\n"
        "def end():\n"
        "    while not list(folder.glob('intrasplat-*/beat')): time.sleep(0.02)\n"
        "    os._exit(0)\n"
        "threading.Thread(target=end).start()\n"
        "run_stand_in(folder, work)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3]), "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, str(script)], env=environment, check=True, timeout=60)
    beats = list(tmp_path.glob("intrasplat-*/beat"))
    assert beats
    last = beats[0].read_text()
    time.sleep(0.3)
    assert beats[0].read_text() == last
