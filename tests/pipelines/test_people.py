"""People whom somebody knows: masks beside the clip, or a model that the user brings."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mosaic.framestore import FrameStore
from mosaic.moving import DISTRUSTED
from pipelines.archive import read_camera_csv
from pipelines.cli import main
from pipelines.compare import compare_run
from pipelines.config import Config, PeopleOptions
from pipelines.errors import ConfigError, MissingToolError
from pipelines.people import MaskFiles, People, open_people
from pipelines.run import process
from tests.synth.clip import ClipSpec, SynthClip, write_clip
from tests.synth.paths import BROADCAST_LENS, PathSpec

SIZE_PX = (96, 64)


def picture_of(index, colour=(0, 0, 0), where=np.s_[10:30, 40:60]):
    """A frame whose picture is gray but for one block."""
    rgb = np.full((SIZE_PX[1], SIZE_PX[0], 3), 100, np.uint8)
    rgb[where] = colour
    return SimpleNamespace(index=index, picture=lambda: rgb)


def write_masks(folder, n, size_px=SIZE_PX):
    folder.mkdir(exist_ok=True)
    for k in range(n):
        mask = np.zeros((size_px[1], size_px[0]), np.uint8)
        mask[: size_px[1] // 4, k : k + size_px[0] // 3] = 255
        cv2.imwrite(str(folder / f"m{k}.png"), mask)


# -- masks ------------------------------------------------------------------------------------------------------------


def test_masks_follow_the_numbers_in_their_names_and_are_made_a_little_wider(tmp_path):
    write_masks(tmp_path / "m", 12)
    people = open_people(PeopleOptions(masks=str(tmp_path / "m")), SIZE_PX, 1)
    for k in (0, 2, 11):  # m11 comes after m2
        scene = people.scene(picture_of(k))
        assert scene.shape == (64, 96) and scene.dtype == bool
        assert not scene[:16, k : k + 32].any()
        assert not scene[16, k : k + 32].all() and scene[18:].all()
        assert scene[:, k + 34 :].all()
    people.scene(picture_of(2))  # the second pass asks again, and does not count twice
    assert people.facts()["n_frames"] == 3
    assert people.facts()["mean_share"] == pytest.approx(1 / 12, abs=0.03)


def test_masks_of_half_the_size_do(tmp_path):
    write_masks(tmp_path / "m", 1, (48, 32))
    found = MaskFiles(str(tmp_path / "m" / "m%d.png")).people(picture_of(0), SIZE_PX)
    assert found[:16, :32].all() and not found[16:].any() and not found[:, 32:].any()


@pytest.mark.parametrize(
    ("make", "index", "cause"),
    [
        (lambda f: None, 0, "no such folder"),
        (lambda f: f.mkdir(), 0, "no images in it"),
        (lambda f: write_masks(f, 3), 3, "has 3 masks, and none for picture 3"),
        (lambda f: write_masks(f, 3, (64, 64)), 0, "is 64x64, the clip 96x64"),
        (lambda f: (f.mkdir(), (f / "m0.png").write_text("no picture")), 0, "cannot be read as a picture"),
    ],
)
def test_masks_that_cannot_be_used_are_said_in_one_line(tmp_path, make, index, cause):
    make(tmp_path / "m")
    with pytest.raises(ConfigError) as caught:
        MaskFiles(str(tmp_path / "m")).people(picture_of(index), SIZE_PX)
    assert cause in str(caught.value) and "\n" not in str(caught.value)


def test_masks_the_wrong_way_round_are_noticed():
    source = SimpleNamespace(people=lambda frame, size: np.ones(size[::-1], bool), forget=lambda frame: None)
    people = People(source, SIZE_PX, "masks")
    for k in range(9):
        people.scene(picture_of(k))
    with pytest.raises(ConfigError, match="covers 100% of the first 10 pictures"):
        people.scene(picture_of(9))


def test_masks_and_a_model_exclude_each_other():
    with pytest.raises(ValueError, match="exclude each other"):
        PeopleOptions(masks="a", model="b")


def test_too_few_masks_end_the_run_in_one_line_and_leave_nothing(tmp_path, capsys):
    write_masks(tmp_path / "few", 5, (64, 36))
    out = tmp_path / "out"
    assert (
        main(["run", "assets/sample.mp4", "-o", str(out), "-q", "--people.masks", str(tmp_path / "few")]) == 2
    )
    said = capsys.readouterr().err.strip()
    assert "has 5 masks, and none for picture 5" in said and "\n" not in said
    assert not (out / "run.json").exists()


def test_masks_of_one_clip_are_not_taken_for_several(tmp_path, capsys):
    write_masks(tmp_path / "m", 5)
    clips = ["assets/sample.mp4", "assets/other.mp4"]
    assert main(["run", *clips, "-o", str(tmp_path / "out"), "--people.masks", str(tmp_path / "m")]) == 2
    said = capsys.readouterr().err.strip()
    assert "belong to one clip, and 2 are named" in said and "\n" not in said


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A clip with players over 40 % of the picture, and its true masks."""
    folder = tmp_path_factory.mktemp("crowded")
    spec = ClipSpec(
        seed=64, width=960, height=540, path=PathSpec(pan_deg=25, zoom=1.7, tilt_deg=2.0), lens=BROADCAST_LENS,
        n_frames=120, n_players=30, player_share=0.4,
    )  # fmt: skip
    write_clip(folder / "clip.mp4", spec)
    clip = SynthClip(spec)
    (folder / "masks").mkdir()
    for k in range(spec.n_frames):
        mask = clip.frame(k).player_mask.astype(np.uint8) * 255
        cv2.imwrite(str(folder / "masks" / f"{k:06d}.png"), mask)
    config = Config.model_validate({"people": {"masks": str(folder / "masks" / "%06d.png")}})
    process(folder / "clip.mp4", folder / "out", config)
    return folder


def test_with_masks_players_over_forty_per_cent_are_no_obstacle(crowded):
    rows = read_camera_csv(crowded / "out" / "camera.csv")
    assert (rows.shot == 0).all() and np.isfinite(rows.zoom_ratio).all()
    shot = compare_run(crowded / "out", crowded / "clip-truth.csv")["shots"][0]
    # Corners over the whole shot follow the focal (stated to 2.6 %); what players would pull is the pairs themselves.
    assert shot["transfer_px"] <= 0.3 and shot["inside_2_sigma"] == 1.0
    assert shot["zoom_rms"] <= 0.002


def test_a_run_with_masks_says_so(crowded):
    record = json.loads((crowded / "out" / "run.json").read_text())
    facts = record["people"]
    assert facts["n_frames"] == 120 and 0.3 < facts["mean_share"] < 0.7
    assert facts["source"].endswith("%06d.png")


# -- a model ----------------------------------------------------------------------------------------------------------


def save(path, nodes, outputs, size=(64, 96), initializers=(), extra_inputs=(), dtype=None):
    """An ONNX model of one picture."""
    onnx = pytest.importorskip("onnx")
    helper, kinds = onnx.helper, onnx.TensorProto
    given = helper.make_tensor_value_info("images", dtype or kinds.FLOAT, [1, 3, *size])
    graph = helper.make_graph(nodes, "g", [given, *extra_inputs], outputs, list(initializers))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return str(path)


def constant(name, values):
    onnx = pytest.importorskip("onnx")
    array = np.asarray(values, np.int64 if name == "labels" else np.float32)
    tensor = onnx.numpy_helper.from_array(array, f"{name}_value")
    return onnx.helper.make_node("Constant", [], [name], value=tensor)


def info(name, shape, kind=None):
    onnx = pytest.importorskip("onnx")
    return onnx.helper.make_tensor_value_info(name, kind or onnx.TensorProto.FLOAT, shape)


def constants(path, **values):
    """A model that says the same of every picture."""
    onnx = pytest.importorskip("onnx")
    kinds = {"labels": onnx.TensorProto.INT64}
    nodes = [constant(name, v) for name, v in values.items()]
    return save(path, nodes, [info(n, list(np.shape(v)), kinds.get(n)) for n, v in values.items()])


def found_by(path, frame=None, size_px=SIZE_PX, **options):
    from pipelines.person_model import PersonModel

    model = PersonModel(PeopleOptions(model=path, **options), 1)
    return model.people(frame or picture_of(0), size_px)


BOX = np.s_[16:48, 24:72]  # rows, columns: centre 48, 32, size 48 x 32
CENTRED = [48.0, 32.0, 48.0, 32.0]


def expected(box=BOX, size_px=SIZE_PX):
    mask = np.zeros(size_px[::-1], bool)
    mask[box] = True
    return mask


def test_a_segmenter_of_one_channel(tmp_path):
    # Red less green: a person wears red.
    onnx = pytest.importorskip("onnx")
    weight = onnx.numpy_helper.from_array(np.array([9, -9, 0], np.float32).reshape(1, 3, 1, 1), "w")
    bias = onnx.numpy_helper.from_array(np.array([-3], np.float32), "b")
    node = onnx.helper.make_node("Conv", ["images", "w", "b"], ["out"])
    path = save(tmp_path / "m.onnx", [node], [info("out", [1, 1, 64, 96])], initializers=[weight, bias])
    frame = picture_of(0, (255, 0, 0), BOX)
    assert (found_by(path, frame) == expected()).all()


def test_a_segmenter_of_classes_at_another_size(tmp_path):
    logits = np.zeros((1, 21, 16, 24), np.float32)
    logits[0, 0] = 1
    logits[0, 15, 4:12, 6:18] = 5
    path = constants(tmp_path / "m.onnx", out=logits)
    assert (found_by(path, person_class=15) == expected()).all()
    assert not found_by(path, person_class=14).any()


def test_a_table_of_boxes_with_the_boxes_in_columns(tmp_path):
    table = np.zeros((1, 4 + 80, 200), np.float32)
    table[0, :4, 7], table[0, 4, 7] = CENTRED, 0.9
    table[0, :4, 9], table[0, 4 + 32, 9] = [20, 20, 9, 9], 0.9  # a ball
    assert (found_by(constants(tmp_path / "m.onnx", out=table)) == expected()).all()


def test_a_table_of_boxes_in_rows_with_a_score_of_their_own(tmp_path):
    table = np.zeros((1, 100, 85), np.float32)
    table[0, 3, :4], table[0, 3, 4], table[0, 3, 5] = CENTRED, 0.8, 0.9
    table[0, 4, :4], table[0, 4, 4], table[0, 4, 5] = [20, 20, 9, 9], 0.2, 0.9  # hardly there
    assert (found_by(constants(tmp_path / "m.onnx", out=table)) == expected()).all()


def test_boxes_in_cells_are_worked_out(tmp_path):
    cells = [(64 // s) * (96 // s) for s in (8, 16, 32)]
    table = np.zeros((1, sum(cells), 85), np.float32)
    row = cells[0] + 2 * 6 + 3  # stride 16, row 2, column 3
    table[0, row, :4] = [0.0, 0.0, np.log(48 / 16), np.log(32 / 16)]
    table[0, row, 4:6] = 0.9
    path = constants(tmp_path / "m.onnx", out=table)
    assert (found_by(path, input="bgr255") == expected()).all()


def test_logits_with_boxes_as_shares(tmp_path):
    logits = np.full((1, 5, 80), -6.0, np.float32)
    logits[0, 2, 0] = 3.0
    boxes = np.full((1, 5, 4), 0.1, np.float32)
    boxes[0, 2] = [0.5, 0.5, 0.5, 0.5]
    path = constants(tmp_path / "m.onnx", pred_logits=logits, pred_boxes=boxes)
    assert (found_by(path) == expected()).all()


def test_boxes_labels_and_scores(tmp_path):
    path = constants(
        tmp_path / "m.onnx", boxes=[[24.0, 16, 72, 48], [0, 0, 9, 9], [80, 50, 90, 60]], labels=[1, 37, 1],
        scores=[0.9, 0.9, 0.1],
    )  # fmt: skip
    assert (found_by(path, person_class=1) == expected()).all()


def test_pictures_of_another_shape_keep_theirs(tmp_path):
    # The network's picture is 96 x 64; of a square one 64 x 64 of it are used.
    path = constants(tmp_path / "m.onnx", boxes=[[16.0, 16, 48, 48]], labels=[0], scores=[0.9])
    rgb = np.zeros((128, 128, 3), np.uint8)
    found = found_by(path, SimpleNamespace(index=0, picture=lambda: rgb), (128, 128))
    assert (found == expected(np.s_[32:96, 32:96], (128, 128))).all()


def test_what_a_model_found_is_asked_for_once(tmp_path):
    from pipelines.person_model import PersonModel

    path = constants(tmp_path / "m.onnx", boxes=[[24.0, 16, 72, 48]], labels=[0], scores=[0.9])
    model, asked = PersonModel(PeopleOptions(model=path), 1), []
    frame = SimpleNamespace(index=4, picture=lambda: asked.append(1) or np.zeros((64, 96, 3), np.uint8))
    model.people(frame, SIZE_PX), model.people(frame, SIZE_PX)
    assert len(asked) == 1
    model.forget(4)
    model.people(frame, SIZE_PX)
    assert len(asked) == 2


def test_models_that_cannot_be_used_are_said_in_one_line(tmp_path):
    (tmp_path / "text.onnx").write_text("no model")
    cases = {
        "cannot be loaded": str(tmp_path / "text.onnx"),
        "no form that is known": constants(tmp_path / "a.onnx", out=np.zeros((2, 2))),
        "has 3 classes, and no class 7": constants(tmp_path / "b.onnx", out=np.zeros((1, 3, 8, 8))),
    }
    for cause, path in cases.items():
        with pytest.raises(ConfigError) as caught:
            found_by(path, person_class=7)
        assert cause in str(caught.value) and "\n" not in str(caught.value)
    onnx = pytest.importorskip("onnx")
    given = info("x", [1, 10])
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Relu", ["x"], ["y"])], "g", [given], [info("y", [1, 10])]
    )
    onnx.save(onnx.helper.make_model(graph, ir_version=8), str(tmp_path / "c.onnx"))
    with pytest.raises(ConfigError, match="does not take one picture"):
        found_by(str(tmp_path / "c.onnx"))


def test_without_onnxruntime_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(MissingToolError, match=r"broadcast-mosaic\[people\]"):
        found_by(str(tmp_path / "m.onnx"))


def test_a_run_with_a_model_leaves_out_what_it_finds(tmp_path, monkeypatch):
    # The model masks the right half of every picture: nothing of it may be in the pairs, or trusted in the panorama.
    path = constants(tmp_path / "m.onnx", boxes=[[48.0, 0, 96, 64]], labels=[0], scores=[0.9])
    spec = ClipSpec(
        seed=3, width=480, height=270, path=PathSpec(pan_deg=12, zoom=1.2), n_frames=30, player_share=0.05
    )  # fmt: skip
    write_clip(tmp_path / "clip.mp4", spec)
    planes, put = [], FrameStore.put

    def recorded(store, frame, rgb, mask=None, trust=None, small=None):
        planes.append(trust)
        put(store, frame, rgb, mask, trust, small)

    monkeypatch.setattr(FrameStore, "put", recorded)
    record = process(
        tmp_path / "clip.mp4", tmp_path / "out", Config.model_validate({"people": {"model": path}})
    )
    assert record.extra["people"]["mean_share"] == pytest.approx(0.5, abs=0.02)
    assert record.extra["people"]["n_frames"] == 30
    pairs = np.load(tmp_path / "out" / "shot-000" / "pairs.npz")
    assert len(pairs["flow_src_px"]) > 50
    assert pairs["flow_src_px"][:, 0].max() < 245
    planes = [plane for plane in planes if plane is not None and plane.shape == (270, 480)]
    assert planes
    for plane in planes:
        assert (plane[:, 245:] == DISTRUSTED).all() and (plane[:, :235] == 255).all()
