import json

import numpy as np
import pytest

from drake_oa.app.main import main

SIZE = (120, 160)
K = [130.0, 130.0, 79.5, 59.5]


def depth_image() -> np.ndarray:
    """A table seen from 0.8 m above, 45 degrees down, and a box on it."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    x, y = (u - K[2]) / K[0], (v - K[3]) / K[1]
    s = np.sqrt(0.5)
    height, depth = 0.8, 0.8 / (s * y + s)
    # The front of a box 1 m away, 0.16 m wide and 0.2 m high, and its top.
    front = 0.8 / (s - s * y)
    up = height - front * (s * y + s)
    depth = np.where((up > 0.0) & (up < 0.2) & (np.abs(front * x) < 0.08), front, depth)
    top = 0.6 / (s * y + s)
    along = top * (s - s * y)
    on_top = (along > 0.8) & (along < 0.95) & (np.abs(top * x) < 0.08)
    return np.where(on_top, top, depth).astype(np.float32)


@pytest.fixture
def scan(tmp_path):
    path = tmp_path / "scan.npz"
    np.savez(path, depth=depth_image(), K=np.array(K))
    return path


def write_png(path, depth, scale=0.001, dtype=np.uint16):
    import open3d

    values = np.nan_to_num(depth / scale).astype(dtype)
    open3d.io.write_image(str(path), open3d.geometry.Image(values))


def test_figures_table_and_picture_of_a_folder(scan, tmp_path, capsys):
    answer, pictures = tmp_path / "out" / "a.json", tmp_path / "pictures"
    write_png(tmp_path / "image.png", depth_image())
    (tmp_path / "image.json").write_text(json.dumps(dict(zip("fx fy cx cy".split(), K))))  # noqa: B905, SIM905
    arguments = ["perceive", str(tmp_path), "--json", str(answer), "--plot", str(pictures)]
    assert main([*arguments, "--repeats", "1"]) == 0
    data = json.loads(answer.read_text())
    image, npz = data["files"]
    assert [image["file"], npz["file"]] == [str(tmp_path / "image.png"), str(scan)]
    assert data["tool"] == "panda"
    assert np.shape(data["tool_W"])[1:] == (3,)
    for frame in (image, npz):
        assert frame["size"] == list(SIZE)
        assert len(frame["clusters"]) == 1
        assert frame["clusters"][0]["enclosed"]
        assert frame["milliseconds"] > 0.0
        assert frame["plane"]["rms"] < 3e-3
    np.testing.assert_allclose(image["plane"]["normal"], npz["plane"]["normal"], atol=5e-3)
    assert "scan.npz" in capsys.readouterr().out
    assert sorted(p.name for p in pictures.iterdir()) == ["image.png", "scan.png"]


def test_pose_tool_and_intrinsics_as_options(scan, tmp_path):
    write_png(tmp_path / "image.png", depth_image(), 0.0002)
    answer = tmp_path / "a.json"
    pose = ["--pose", "1", "2", "0.8", str(-0.75 * np.pi), "0", str(-np.pi / 2)]
    arguments = ["perceive", str(tmp_path / "image.png"), "--json", str(answer), *pose]
    options = ["--intrinsics", *map(str, K), "--depth-scale", "0.0002", "--tool", "0.1,0.1,0.2"]
    assert main([*arguments, *options, "--repeats", "1"]) == 0
    (frame,) = json.loads(answer.read_text())["files"]
    assert frame["X_WC"][0][3] == 1.0
    assert frame["plane"]["offset"] == pytest.approx(-0.8, abs=3e-3)
    box = frame["clusters"][0]["ellipsoid"]["semi_axes"]
    assert main([*arguments, *options[:-1], "none", "--repeats", "1"]) == 0
    (frame,) = json.loads(answer.read_text())["files"]
    assert frame["clusters"][0]["ellipsoid"]["semi_axes"][0] < box[0]


def test_a_file_that_cannot_be_used_is_named_and_the_others_are_processed(scan, tmp_path, capsys):
    broken, text = tmp_path / "broken.npz", tmp_path / "notes.txt"
    broken.write_bytes(b"no such data")
    text.write_text("")
    answer = tmp_path / "a.json"
    files = [str(broken), str(text), str(tmp_path / "none.npz"), str(scan)]
    assert main(["perceive", *files, "--json", str(answer), "--tool", "none"]) == 2
    error = capsys.readouterr().err
    assert "broken.npz" in error
    assert "'.txt'; valid are .npz, .pcd, .ply, .png" in error
    assert "none.npz" in error
    frames = json.loads(answer.read_text())["files"]
    assert [("error" in frame) for frame in frames] == [True, True, False]


@pytest.mark.parametrize(
    ("depth", "note"),
    [(np.full(SIZE, np.nan), "no valid pixel"), (np.zeros(SIZE), "no valid pixel")],
)
def test_a_frame_without_measurements_is_reported(tmp_path, capsys, depth, note):
    path, answer = tmp_path / "empty.npz", tmp_path / "a.json"
    np.savez(path, depth=depth, K=np.array(K))
    assert main(["perceive", str(path), "--json", str(answer), "--plot", str(tmp_path / "p")]) == 1
    assert note in capsys.readouterr().err
    (frame,) = json.loads(answer.read_text())["files"]
    assert (frame["plane"], frame["clusters"], frame["note"]) == (None, [], note)
    assert (tmp_path / "p" / "empty.png").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--tool", "hammer"], "--tool must be panda, none or LX,LY,LZ"),
        (["--intrinsics", "0", "1", "1", "1"], "--intrinsics: intrinsics must be"),
        (["--depth-scale", "0"], "--depth-scale must be positive"),
        (["--pose", "0", "0", "nan", "0", "0", "0"], "--pose must be six finite"),
        (["--repeats", "0"], "--repeats must be at least 1"),
        (["--far", "0.1"], "--near, --far: SegmentationConfig.near must be less than far"),
    ],
)
def test_options_that_make_no_sense_are_refused(scan, capsys, options, message):
    assert main(["perceive", str(scan), "--tool", "none", *options]) == 2
    assert message in capsys.readouterr().err


def test_pictures_do_not_replace_images(tmp_path, capsys):
    write_png(tmp_path / "image.png", depth_image())
    path = str(tmp_path / "image.png")
    assert main(["perceive", path, "--plot", str(tmp_path), "--tool", "none"]) == 2
    assert "the command reads this file" in capsys.readouterr().err
