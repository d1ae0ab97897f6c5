"""The panorama's files, read back by other programs' readers and, where they are installed, by their own tools."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import time
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from mosaic.composite import Canvas, Panorama
from mosaic.surface import KINDS, Surface, choose_surface
from pipelines.exports.panorama_deepzoom import write_panorama_deepzoom
from pipelines.exports.panorama_jpeg import gpano_fields, scaled_surface, write_panorama_jpeg
from pipelines.exports.panorama_json import panorama_facts, read_surface, write_panorama_json
from pipelines.exports.panorama_png import write_panorama_png
from pipelines.exports.panorama_tiff import halve, write_panorama_tiff
from pipelines.exports.pto import PtoFrame, hugin_lens, image_line, panorama_line, write_pto
from pipelines.exports.srgb import srgb_profile
from pipelines.exports.whole_file import whole_file
from tests.mosaic.pinhole import Pinhole, sweep

RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"


def panorama_on(surface, seed=1):
    """A panorama of smooth colours with a hole, no frames behind it."""
    size = (surface.height, surface.width)
    y, x = np.mgrid[: size[0], : size[1]]
    rng = np.random.default_rng(seed)
    waves = [np.sin(x / a + i) * np.cos(y / b) for i, (a, b) in enumerate(rng.uniform(15, 60, (3, 2)))]
    image = np.rint(127 + 110 * np.stack(waves, axis=-1)).astype(np.uint8)
    alpha = np.full(size, 255, np.uint8)
    alpha[: size[0] // 5, : size[1] // 7] = 0
    image[alpha == 0] = 0
    return Panorama(
        image=image, alpha=alpha, surface=surface, n_seen=(alpha // 15), spread=np.ones_like(alpha), frames=(2, 5),
        placements={}, gains=np.ones((2, 3)),
    )  # fmt: skip


SURFACE = Surface(kind="equirectangular", scale_px=1000 / np.pi, cx=699.5, cy=299.5, width=1311, height=571)


def test_tiff_is_tiled_deflated_and_exact(tmp_path):
    panorama = panorama_on(SURFACE)
    n_levels = write_panorama_tiff(panorama, tmp_path / "panorama.tif")
    with tifffile.TiffFile(tmp_path / "panorama.tif") as tif:
        page, series = tif.pages[0], tif.series[0]
        assert page.is_tiled and page.tile == (512, 512) and page.compression.name == "ADOBE_DEFLATE"
        assert [e.name for e in page.extrasamples] == ["UNASSALPHA"] and not tif.is_bigtiff
        assert [level.shape for level in series.levels] == [(571, 1311, 4), (286, 656, 4), (143, 328, 4)]
        assert n_levels == 3
        full = page.asarray()
        np.testing.assert_array_equal(full[..., :3], panorama.image)
        np.testing.assert_array_equal(full[..., 3], panorama.alpha)
        assert b"FullPanoWidthPixels" in page.tags[700].value
        half = series.levels[1].asarray()
    middle = panorama.image[200:202, 300:302].mean(axis=(0, 1))
    np.testing.assert_allclose(half[100, 150, :3], middle, atol=0.51)
    with Image.open(tmp_path / "panorama.tif") as picture:  # libtiff reads it too
        np.testing.assert_array_equal(np.asarray(picture), full)


def deep_panorama():
    """panorama_on's picture with 16 bits that 8 cannot hold."""
    panorama = panorama_on(SURFACE)
    below = np.random.default_rng(4).integers(-128, 129, panorama.image.shape)
    return replace(
        panorama, deep=np.clip(panorama.image.astype(int) * 257 + below, 0, 65535).astype(np.uint16)
    )


def test_a_clip_of_more_than_8_bits_has_a_tiff_of_16(tmp_path):
    panorama = deep_panorama()
    write_panorama_tiff(panorama, tmp_path / "panorama.tif")
    with tifffile.TiffFile(tmp_path / "panorama.tif") as tif:
        assert tif.pages[0].dtype == np.uint16 and "sRGB" in ImageCms.getProfileDescription(
            ImageCms.ImageCmsProfile(io.BytesIO(tif.pages[0].iccprofile))
        )
        full, half = (level.asarray() for level in tif.series[0].levels[:2])
    np.testing.assert_array_equal(full[..., :3], panorama.deep)
    np.testing.assert_array_equal(full[..., 3], panorama.alpha * np.uint16(257))
    middle = panorama.deep[200:202, 300:302].mean(axis=(0, 1))
    np.testing.assert_allclose(half[100, 150, :3], middle, atol=0.51)


def test_tiff_and_jpeg_are_tagged_srgb(tmp_path):
    panorama = panorama_on(SURFACE)
    write_panorama_tiff(panorama, tmp_path / "panorama.tif")
    write_panorama_jpeg(panorama, tmp_path / "panorama.jpg")
    with tifffile.TiffFile(tmp_path / "panorama.tif") as tif, Image.open(tmp_path / "panorama.jpg") as jpeg:
        tags = [tif.pages[0].iccprofile, jpeg.info["icc_profile"]]
    for tag in tags:
        assert "sRGB" in ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(tag)))


def test_the_colour_tag_does_not_tell_the_time():
    first = srgb_profile()
    srgb_profile.cache_clear()
    time.sleep(1.1)  # the header's date counts seconds
    assert srgb_profile() == first


def test_unseen_black_does_not_darken_the_reduced_levels(tmp_path):
    image, alpha = np.full((6, 5, 3), 200, np.uint8), np.full((6, 5), 255, np.uint8)
    alpha[:, :3], image[:, :3] = 0, 0
    small, cover = halve(image, alpha, Canvas(tmp_path, 10_000))
    np.testing.assert_array_equal(cover, [[0, 128, 255]] * 3)
    np.testing.assert_array_equal(small[..., 0], [[0, 200, 200]] * 3)


@pytest.mark.parametrize("kind", ["cylindrical", "planar", "pannini"])
def test_only_equirectangular_pictures_claim_gpano(tmp_path, kind):
    surface = Surface(kind=kind, scale_px=300.0, cx=99.5, cy=49.5, width=200, height=100)
    write_panorama_jpeg(panorama_on(surface), tmp_path / "p.jpg")
    write_panorama_tiff(panorama_on(surface), tmp_path / "p.tif")
    assert b"GPano" not in (tmp_path / "p.jpg").read_bytes() + (tmp_path / "p.tif").read_bytes()
    with pytest.raises(ValueError, match=kind):
        gpano_fields(surface)


def test_jpeg_says_where_it_lies_on_the_sphere(tmp_path):
    panorama = panorama_on(SURFACE)
    assert write_panorama_jpeg(panorama, tmp_path / "p.jpg", quality=95) == (1311, 571)
    with Image.open(tmp_path / "p.jpg") as picture:
        description = next(ElementTree.fromstring(picture.info["xmp"]).iter(RDF + "Description"))
        error = np.asarray(picture).astype(float) - panorama.image
    assert np.sqrt(np.mean(error[panorama.alpha > 0] ** 2)) < 2
    found = {name.split("}")[-1]: value for name, value in description.attrib.items()}
    left, top = int(found["CroppedAreaLeftPixels"]), int(found["CroppedAreaTopPixels"])
    full = int(found["FullPanoWidthPixels"])
    assert (
        full == 2000
        and int(found["FullPanoHeightPixels"]) == 1000
        and found["ProjectionType"] == "equirectangular"
    )
    # By GPano: longitude of a pixel's middle = (left + x + .5) / full * 360 - 180, latitude likewise from the top.
    x, y = 400.0, 123.0
    lon, lat = ((left + x + 0.5) / full - 0.5) * 2 * np.pi, (0.25 - (top + y + 0.5) / full) * 2 * np.pi
    ray = [np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)]
    np.testing.assert_allclose(panorama.pixel_to_ray([x, y]), ray, atol=1e-12)


def test_a_wide_picture_is_reduced_in_place(tmp_path):
    panorama = panorama_on(SURFACE)
    assert write_panorama_jpeg(panorama, tmp_path / "p.jpg", max_width_px=437, quality=97) == (437, 190)
    with Image.open(tmp_path / "p.jpg") as picture:
        small = np.asarray(picture).astype(float)
    scaled = scaled_surface(SURFACE, (437, 190))
    at = SURFACE.ray_to_pixel(scaled.pixel_to_ray([[200.0, 100.0], [350.0, 60.0]]))
    np.testing.assert_allclose(at, [[601.0, 301.4], [1051.0, 181.3]], atol=0.5)
    for (x, y), (u, v) in zip([(200, 100), (350, 60)], np.rint(at).astype(int), strict=True):
        around = panorama.image[v - 1 : v + 2, u - 1 : u + 2].mean(axis=(0, 1))
        np.testing.assert_allclose(small[y, x], around, atol=8)


@pytest.mark.oracle
@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
def test_exiftool_reads_gpano_from_both_files(tmp_path):
    panorama = panorama_on(SURFACE)
    write_panorama_jpeg(panorama, tmp_path / "p.jpg")
    write_panorama_tiff(panorama, tmp_path / "p.tif")
    for name in ("p.jpg", "p.tif"):
        out = subprocess.run(
            ["exiftool", "-j", "-n", "-XMP-GPano:all", tmp_path / name],
            capture_output=True,
            check=True,
            text=True,
        )
        found = {k: str(v) for k, v in json.loads(out.stdout)[0].items()}
        expected = gpano_fields(SURFACE)
        assert {k: found[k] for k in expected} == expected


def test_json_gives_the_same_rays_to_anybody(tmp_path):
    write_panorama_json(panorama_on(SURFACE), tmp_path / "panorama.json", world="levelled")
    facts = json.loads((tmp_path / "panorama.json").read_text())
    assert (
        facts["world"] == "levelled"
        and facts["frames"] == [2, 5]
        and facts["projection"] == "equirectangular"
    )
    (cx, cy), s = facts["centre_px"], facts["scale_px_per_rad"]
    lon, lat = (77.25 - cx) / s, -(400.5 - cy) / s  # the formula that the file states
    ray = [np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)]
    np.testing.assert_allclose(SURFACE.pixel_to_ray([77.25, 400.5]), ray, atol=1e-12)
    assert read_surface(tmp_path / "panorama.json") == SURFACE
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match=r"other\.json"):
        read_surface(tmp_path / "other.json")


def test_json_says_the_lenss_falloff():
    assert panorama_facts(panorama_on(SURFACE), world="levelled")["falloff"] is None
    lens = Pinhole(size_px=(320, 180))
    found = replace(panorama_on(SURFACE), falloff=np.array([-0.15, -0.014]), placements={2: lens, 5: lens})
    facts = panorama_facts(found, world="levelled")["falloff"]
    r2 = (320**2 + 180**2) / 320**2  # of a corner, in half widths
    assert facts["corner"] == pytest.approx(np.exp(facts["a"] * r2 + facts["b"] * r2**2), abs=1e-4)
    assert facts["corner"] == pytest.approx(0.8, abs=0.01)


# --- Hugin ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k1", [-0.3, -0.11, 0.0, 0.08, 0.4])
def test_hugins_lens_is_ours(k1):
    f, size = 1500.0, (1280, 720)
    g, b = hugin_lens(f, k1, size)
    tangent = np.linspace(0, 0.49, 50)
    radius = g * tangent / 360
    np.testing.assert_allclose(
        360 * radius * (b * radius**2 + 1 - b), f * tangent * (1 + k1 * tangent**2), rtol=1e-9
    )


def test_a_lens_that_folds_back_is_refused():
    with pytest.raises(ValueError, match="no counterpart"):
        hugin_lens(400.0, -0.9, (1920, 1080))


def pto_frame(placement, name):
    (cx, cy), radians = (
        placement.centre,
        np.radians([placement.pan_deg, placement.tilt_deg, placement.roll_deg]),
    )
    return PtoFrame(
        name=name, size_px=placement.size_px, f_px=placement.f_px, pan_rad=radians[0], tilt_rad=radians[1],
        roll_rad=radians[2], cx_px=cx, cy_px=cy, k1=placement.k1,
    )  # fmt: skip


def test_image_line_has_plain_numbers():
    line = image_line(
        pto_frame(Pinhole(f_px=np.float64(400), pan_deg=np.float64(7.25), tilt_deg=-3.0), "a b.png")
    )
    assert line.startswith("i w320 h180 f0 v43.6028") and line.endswith('n"a b.png"')
    assert " d0.0 e0.0 " in line and "float" not in line
    numbers = {word[0]: float(word[1:]) for word in line.split()[5:7] + line.split()[7:8]}
    assert numbers == pytest.approx({"r": 0.0, "p": -3.0, "y": 7.25}, abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_panorama_line_puts_the_forward_axis_in_the_canvas_middle(kind):
    surface = choose_surface(sweep((-4, 11), n=5, f_px=700.0, tilt_deg=5.0), kind)
    words = panorama_line(surface).split()
    width, height, field = (float(words[i][1:]) for i in (2, 3, 4))
    x0, x1, y0, y1 = (int(v) for v in words[5][1:].split(","))
    assert (x1 - x0, y1 - y0) == (surface.width, surface.height) and x0 >= 0 and x1 <= width and y1 <= height
    assert (surface.cx + x0, surface.cy + y0) == ((width - 1) / 2, (height - 1) / 2)
    half = np.radians(field) / 2
    edge = {"planar": np.tan(half), "pannini": 2 * np.tan(half / 2)}.get(kind, half)
    scale = width / 2 / edge
    assert scale == pytest.approx(surface.scale_px, rel=1e-12)


def test_pto_refuses_what_hugin_would_misread(tmp_path):
    good = pto_frame(Pinhole(), "a.png")
    with pytest.raises(ValueError, match="at least one"):
        write_pto(tmp_path / "p.pto", SURFACE, [])
    with pytest.raises(ValueError, match="finite"):
        PtoFrame(name="a", size_px=(9, 9), f_px=np.nan, pan_rad=0, tilt_rad=0, roll_rad=0, cx_px=4, cy_px=4)
    write_pto(tmp_path / "p.pto", SURFACE, [good, good])
    lines = (tmp_path / "p.pto").read_text().splitlines()
    assert [line[0] for line in lines if line] == ["#", "p", "m", "i", "i"]


@pytest.mark.oracle
@pytest.mark.skipif(shutil.which("nona") is None, reason="hugin-tools is not installed")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("k1", [-0.11, 0.08])
def test_nona_renders_to_our_place(tmp_path, kind, k1):
    placement = Pinhole(size_px=(640, 360), f_px=800.0, pan_deg=7.5, tilt_deg=-3.2, roll_deg=0.4, k1=k1)
    surface = choose_surface([placement, Pinhole(size_px=(640, 360), f_px=800.0, pan_deg=-6)], kind)
    x, y = np.meshgrid(np.arange(640), np.arange(360))
    coordinates = np.stack([x / 2000, y / 2000, np.full(x.shape, 0.9)], axis=-1).astype(np.float32)
    tifffile.imwrite(tmp_path / "frame.tif", coordinates, photometric="rgb")
    write_pto(tmp_path / "p.pto", surface, [pto_frame(placement, str(tmp_path / "frame.tif"))])
    subprocess.run(
        ["nona", "--ignore-exposure", "-m", "TIFF_m", "-p", "FLOAT", "-z", "NONE", "-o", "out", "p.pto"],
        cwd=tmp_path, check=True, capture_output=True,
    )  # fmt: skip
    with tifffile.TiffFile(tmp_path / "out0000.tif") as tif:
        page = tif.pages[0]
        picture = page.asarray()
        offset = [
            round(page.tags[n].value[0] / page.tags[n].value[1] * page.tags[r].value[0] / page.tags[r].value[1])
            if n in page.tags else 0
            for n, r in (("XPosition", "XResolution"), ("YPosition", "YResolution"))
        ]  # fmt: skip
    words = panorama_line(surface).split()[5][1:].split(",")
    rows, columns = np.nonzero(picture[..., 2] > 0.89)
    ours = np.stack([columns + offset[0] - int(words[0]), rows + offset[1] - int(words[2])], axis=-1)
    expected = placement.ray_to_pixel(surface.pixel_to_ray(ours))
    error = np.linalg.norm(picture[rows, columns, :2] * 2000 - expected, axis=-1)
    inside = ((expected > 1) & (expected < [638, 358])).all(
        axis=-1
    )  # at the border nona continues the outer pixels
    assert inside.sum() > 100_000 and np.median(error[inside]) < 0.06 and error[inside].max() < 0.15


# --- on demand -------------------------------------------------------------------------------------------------------


def test_png_holds_every_pixel_and_says_srgb(tmp_path):
    panorama = panorama_on(SURFACE)
    write_panorama_png(panorama, tmp_path / "p.png")
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.mode == "RGBA" and "srgb" in picture.info
        read = np.asarray(picture)
    np.testing.assert_array_equal(read[..., :3], panorama.image)
    np.testing.assert_array_equal(read[..., 3], panorama.alpha)


def test_deep_zoom_tiles_lie_where_the_format_says(tmp_path):
    panorama = panorama_on(SURFACE)
    files = write_panorama_deepzoom(panorama, tmp_path / "panorama.dzi", quality=95)
    assert set(files) == {p for p in tmp_path.rglob("*") if p.is_file()}
    image = ElementTree.parse(tmp_path / "panorama.dzi").getroot()
    space = "{http://schemas.microsoft.com/deepzoom/2008}"
    assert image.tag == f"{space}Image"
    side, overlap = int(image.get("TileSize")), int(image.get("Overlap"))
    size = image.find(f"{space}Size")
    assert (int(size.get("Width")), int(size.get("Height"))) == (1311, 571)
    levels = tmp_path / "panorama_files"
    assert sorted(int(p.name) for p in levels.iterdir()) == list(range(12))  # 2^10 < 1311 <= 2^11
    for level in range(12):
        width, height = (-(-n // 2 ** (11 - level)) for n in (1311, 571))
        whole = np.zeros((height, width, 3))
        for tile in (levels / str(level)).iterdir():
            column, row = (int(n) for n in tile.stem.split("_"))
            with Image.open(tile) as picture:
                part = np.asarray(picture)
            left, top = (max(n * side - overlap, 0) for n in (column, row))
            right, bottom = min((column + 1) * side + overlap, width), min((row + 1) * side + overlap, height)
            assert part.shape[:2] == (bottom - top, right - left)
            whole[top:bottom, left:right] = part
        assert (whole[height // 2 :].max(axis=-1) > 0).all()  # no tile is missing
        if level == 11:
            error = (whole - panorama.image)[panorama.alpha > 0]
            assert np.sqrt(np.mean(error**2)) < 2


@pytest.mark.oracle
@pytest.mark.skipif(shutil.which("exiftool") is None, reason="libimage-exiftool-perl is not installed")
def test_exiftool_reads_where_the_picture_lies(tmp_path):
    write_panorama_jpeg(panorama_on(SURFACE), tmp_path / "p.jpg")
    write_panorama_tiff(panorama_on(SURFACE), tmp_path / "p.tif")
    for name in ("p.jpg", "p.tif"):
        done = subprocess.run(
            ["exiftool", "-j", "-n", "-XMP-GPano:all", str(tmp_path / name)], check=True, capture_output=True
        )
        [found] = json.loads(done.stdout)
        expected = gpano_fields(SURFACE)
        assert {key: str(found[key]) for key in expected if key != "UsePanoramaViewer"} == {
            key: value for key, value in expected.items() if key != "UsePanoramaViewer"
        }


@pytest.mark.oracle
@pytest.mark.skipif(shutil.which("vips") is None, reason="libvips-tools is not installed")
def test_vips_opens_every_level_of_the_tiff(tmp_path):
    panorama = panorama_on(SURFACE)
    write_panorama_tiff(panorama, tmp_path / "p.tif")
    subprocess.run(["vips", "copy", f"{tmp_path / 'p.tif'}", f"{tmp_path / 'full.png'}"], check=True)
    subprocess.run(
        ["vips", "copy", f"{tmp_path / 'p.tif'}[subifd=0]", f"{tmp_path / 'half.png'}"], check=True
    )
    with Image.open(tmp_path / "full.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture)[..., :3], panorama.image)
    with Image.open(tmp_path / "half.png") as picture:
        assert picture.size == (656, 286)


@pytest.mark.oracle
@pytest.mark.skipif(shutil.which("vips") is None, reason="libvips-tools is not installed")
def test_vips_reads_16_bits(tmp_path):
    panorama = deep_panorama()
    write_panorama_tiff(panorama, tmp_path / "p.tif")
    subprocess.run(["vips", "rawsave", f"{tmp_path / 'p.tif'}", f"{tmp_path / 'p.raw'}"], check=True)
    rgba = np.fromfile(tmp_path / "p.raw", np.uint16).reshape(*panorama.alpha.shape, 4)
    np.testing.assert_array_equal(rgba[..., :3], panorama.deep)
    np.testing.assert_array_equal(rgba[..., 3], panorama.alpha * np.uint16(257))


# --- whole files -----------------------------------------------------------------------------------------------------


def test_a_writer_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "panorama.tif"
    path.write_text("old")
    broken = SimpleNamespace(
        alpha=np.zeros((600, 600), np.uint8), image=np.zeros((9, 9, 3), np.uint8), deep=None, surface=SURFACE,
        release=lambda: None, n_seen=None,
    )  # fmt: skip
    with pytest.raises(ValueError, match="broadcast"):
        write_panorama_tiff(broken, path)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["panorama.tif"]


def test_whole_file_is_as_public_as_other_files(tmp_path):
    (tmp_path / "plain").write_text("")
    with whole_file(tmp_path / "whole") as temporary:
        temporary.write_text("x")
        assert not (tmp_path / "whole").exists()
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "plain").stat().st_mode
    with pytest.raises(OSError), whole_file(tmp_path / "missing" / "file"):
        pass
