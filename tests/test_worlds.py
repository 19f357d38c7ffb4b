"""The renderer of the study's worlds, on a box built here and on the game's maps."""

import json
import math
import struct
from pathlib import Path

import cv2
import numpy as np
import omg
import pytest
from worlds import dataset, geometry, poses, render, scene, textures, wad
from worlds.lenses import draw_lens

from darswin.lens import Equidistant, Perspective, Spherical, load

ROOT = Path(__file__).parent.parent


def needs_game(test):
    there = (wad.FOLDER / "freedoom1.wad").exists()
    reason = "the game's files are not installed"
    return pytest.mark.slow(pytest.mark.skipif(not there, reason=reason)(test))


LABEL = geometry.LABEL

# -- a box of 512 × 256 × 128 units with a step of 16 in its eastern half ---------------------


def box_wad() -> omg.WAD:
    """Two sectors side by side; the wall's texture has one colour a quarter, flats are even."""
    made = omg.WAD()
    palette = bytes(range(256)) * 3
    made.data["PLAYPAL"] = omg.Lump(palette[:768])
    quarters = np.repeat(np.repeat([[10, 20], [30, 40]], 64, 0), 64, 1)
    patch = omg.Graphic()
    patch.from_pixels(quarters.ravel().tolist(), 128, 128)
    made.patches["QUARTERS"] = patch
    entry = struct.pack("<8s4xhh4xh", b"WALL", 128, 128, 1) + struct.pack("<hhh4x", 0, 0, 0)
    made.txdefs["TEXTURE1"] = omg.Lump(struct.pack("<ii", 1, 8) + entry)
    made.txdefs["PNAMES"] = omg.Lump(struct.pack("<i8s", 1, b"QUARTERS"))
    for name, index in (("GROUND", 50), ("ROOF", 60), ("NUKAGE1", 70)):
        made.flats[name] = omg.Flat(bytes([index]) * 4096)
    world = omg.MapEditor()
    places = [(0, 0), (0, 256), (256, 256), (512, 256), (512, 0), (256, 0)]
    world.vertexes = [omg.Vertex(x, y) for x, y in places]
    world.sectors = [
        omg.Sector(z_floor=0, z_ceil=128, tx_floor="GROUND", tx_ceil="ROOF", light=255),
        omg.Sector(z_floor=16, z_ceil=128, tx_floor="NUKAGE1", tx_ceil="F_SKY1", light=255),
    ]
    # Lines have their sector on the right: clockwise.
    for start, end, front, back in (
        (0, 1, 0, None), (1, 2, 0, None), (2, 3, 1, None), (3, 4, 1, None), (4, 5, 1, None),
        (5, 0, 0, None), (2, 5, 0, 1),
    ):  # fmt: skip
        sides = []
        for sector in (front, back):
            if sector is not None:
                middle = "WALL" if back is None else "-"
                sides.append(len(world.sidedefs))
                world.sidedefs.append(omg.Sidedef(tx_mid=middle, tx_low="WALL", sector=sector))
        line = omg.Linedef(vx_a=start, vx_b=end, front=sides[0])
        if back is not None:
            line.back, line.two_sided = sides[1], True
        world.linedefs.append(line)
    made.maps["MAP01"] = world.to_lumps()
    return made


@pytest.fixture(scope="module")
def box() -> scene.Scene:
    made = box_wad()
    return scene.Scene(wad.read_map(made, "MAP01", "box-MAP01"), textures.Textures(made))


def eye(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z]) / wad.METRE


def test_a_box_has_exact_labels_and_distances(box):
    ways = np.array(
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1], [1, 0, -0.2], [1, 0, -0.25], [1, 0, -0.15]]
    )
    length = np.linalg.norm(ways, axis=1)
    hits = box.cast(eye(100, 120, 48), ways / length[:, None])
    names = [geometry.CLASSES[label] for label in hits.label]
    # At x = 256 the slanted rays are 156 × slope lower: at 16.8, 9 and 24.6 of a step of 16.
    assert names == ["wall", "wall", "floor", "ceiling", "liquid", "step", "liquid"]
    beyond = [32 / 0.2 * length[4], 156 * length[5], 32 / 0.15 * length[6]]
    expected = np.array([100, 136, 48, 80, *beyond]) / wad.METRE
    np.testing.assert_allclose(hits.distance, expected, rtol=1e-12)
    hits = box.cast(eye(400, 120, 48), np.array([[0.0, 0.0, 1.0]]))
    assert hits.label[0] == LABEL["sky"] and np.isinf(hits.distance[0])


@pytest.mark.slow
def test_a_wall_shows_its_texture_upright_and_not_mirrored(box):
    at = eye(128, 64, 64)
    targets = eye(0, 32, 100), eye(0, 96, 100), eye(0, 32, 30), eye(0, 96, 30)
    ways = np.array(targets) - at
    hits = box.cast(at, ways / np.linalg.norm(ways, axis=1)[:, None])
    palette = np.frombuffer(bytes(range(256)) * 3, np.uint8)[:768].reshape(256, 3)
    # The line runs from y = 0 to 256 in the west, so from left to right for one who looks west.
    np.testing.assert_array_equal(hits.colour, palette[[10, 20, 30, 40]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "lens",
    [
        Equidistant(20.0, theta_max=math.radians(110), image_size=(64, 80)),
        Spherical.from_fov(0.3, math.radians(165), 32, image_size=(64, 64)),
        Perspective(40.0, image_size=(48, 64), theta_max=1.0),
    ],
)
def test_a_pixel_shows_what_its_ray_meets(box, lens):
    pose = poses.Pose(eye(300, 100, 60), poses.look(0.7, 0.2, -0.1))
    view = render.render(box, pose, render.rays_of(lens))
    height, width = (int(side) for side in lens.image_size[0])
    y, x = np.mgrid[:height, :width]
    pixels = lens.theta_max.new_tensor(np.stack((x, y), -1).tolist())[None]
    theta, azimuth = (angle[0].numpy().astype(float) for angle in lens.unproject_pixels(pixels))
    seen = ~np.isnan(theta)
    assert ((view.labels == scene.NOTHING) == ~seen).all() and (view.distance[~seen] == 0).all()
    across = np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth)
    ways = np.stack((*across, np.cos(theta)), -1)[seen] @ pose.rotation.T
    hits = box.cast(pose.position, ways)
    known = np.isfinite(hits.distance)
    same = view.labels[seen] == hits.label
    assert same.mean() > 0.99  # but for rays on an edge
    np.testing.assert_allclose(
        view.distance[seen][known & same], hits.distance[known & same], rtol=2e-4
    )
    assert {"liquid", "wall"} <= {geometry.CLASSES[k] for k in hits.label}
    assert (view.distance[view.labels == LABEL["sky"]] == 0).all()


@pytest.mark.slow
def test_rotations_are_those_of_a_camera_and_colours_linear():
    rotation = poses.look(0.3, 0.2, 0.1)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    level = poses.look(math.pi / 2)  # to the north: east is right, and down is down
    np.testing.assert_allclose(level.T, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    assert poses.look(0.0, pitch=0.5)[2, 2] > 0  # up
    assert poses.look(0.0, roll=0.5)[2, 0] < 0  # clockwise: the right side sinks
    # Colours are averaged in linear light.
    assert (render.to_srgb(render.to_linear(np.arange(256))) == np.arange(256)).all()
    assert render.to_srgb(np.array([0.5])) == 188


@pytest.mark.slow
def test_outlines_with_holes_and_gaps_are_filled():
    def sides(corners):
        return np.stack((corners, np.roll(corners, -1, 0)), 1).astype(float)

    def area(triangles):
        return float(np.abs(np.linalg.det(triangles[:, 1:] - triangles[:, :1])).sum() / 2)

    square = np.array([[0, 0], [0, 4], [4, 4], [4, 0]])
    ring = np.concatenate((sides(square), sides(square / 2 + 1)))
    assert area(geometry.triangulate(ring)) == pytest.approx(12)
    triangle = np.array([[0, 0], [3, 5], [7, 1]])
    assert area(geometry.triangulate(sides(triangle))) == pytest.approx(16)
    assert area(geometry.triangulate(sides(square)[:2])) == 0


# -- the game's maps --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def game() -> tuple[scene.Scene, list[poses.Pose]]:
    name = "freedoom2-MAP01"
    opened, world = wad.load_map(name)
    built = scene.Scene(world, textures.Textures(opened))
    return built, poses.poses_of(built, name, 5, seed=0)


@needs_game
def test_splits_share_no_map():
    of = {split: set(wad.map_names(split)) for split in dataset.SPLITS}
    assert all(of.values()) and len(set.union(*of.values())) == sum(map(len, of.values())) == 68


@needs_game
def test_no_ray_leaves_a_world(game):
    """From places to stand on that were not chosen for it; fewer than 1 in 1000 may."""
    built, _ = game
    triangles, weight = poses._floors(built)
    rng, sphere = np.random.default_rng(1), poses._sphere(3000)
    lost = []
    for k in rng.choice(len(triangles), 60, p=weight):
        at = triangles[k].mean(0) + np.array([0, 0, 0.2])
        hits = built.cast(at, sphere)
        above = built.cast(at, np.array([[0.0, 0.0, 1.0]]))
        if above.normal[0, 2] < 0:  # else that is above a low ceiling
            lost.append((hits.label == scene.NOTHING).mean())
    assert len(lost) > 40 and np.mean(lost) < 1e-3


@needs_game
def test_a_data_set_is_the_same_bits_from_the_seed(tmp_path):
    for folder in ("one", "two"):
        out = str(tmp_path / folder)
        targets = [dataset.Target(f"{out}-low", "0.2..0.35"), dataset.Target(f"{out}-0.5", "0.5")]
        (job,) = dataset.jobs_of(targets, "val", 1, size=32, seed=3)
        dataset.write_map(*job)
    for kind in ("low", "0.5"):
        one, two = tmp_path / f"one-{kind}", tmp_path / f"two-{kind}"
        files = [p.relative_to(one) for p in one.rglob("*") if p.is_file()]
        assert {p.parts[1] for p in files if len(p.parts) > 2} >= {"images", "labels", "distance"}
        assert all((one / p).read_bytes() == (two / p).read_bytes() for p in files)
    assert load(next((tmp_path / "one-low" / "val" / "lenses").iterdir())).xi.item() < 0.35
    assert load(tmp_path / "one-0.5" / "val" / "lens.json").xi.item() == 0.5
    (labels,) = (tmp_path / "one-0.5" / "val" / "labels").iterdir()
    names = json.loads((tmp_path / "one-0.5" / "classes.json").read_text())["names"]
    found = np.unique(cv2.imread(str(labels), cv2.IMREAD_UNCHANGED))
    assert found[-1] == 255 and found[-2] < len(names)
    # What was made otherwise is not mixed with it.
    with pytest.raises(ValueError, match="was made with"):
        dataset.write_map(*job[:3], 64, *job[4:])


@pytest.mark.slow
def test_real_cameras_are_cut_to_a_square_and_a_missing_game_is_named():
    name = str(ROOT / "tests" / "lens" / "files" / "woodscape.json")
    lens = draw_lens(name, 128, 2.9, np.random.default_rng(0))
    assert lens.image_size.tolist() == [[128, 128]]
    # The pixel right of the middle, in the whole picture of 1280 × 966.
    whole, scale = load(name), 966 / 128
    pixel = lens.theta_max.new_tensor([[100.0, 70.0]])
    there = (pixel + 0.5) * scale - 0.5 + lens.theta_max.new_tensor([157.0, 0.0])
    np.testing.assert_allclose(
        lens.unproject_points(pixel), whole.unproject_points(there), atol=1e-5
    )
    with pytest.raises(SystemExit, match="apt-get install freedoom"):
        wad.map_names(folder=ROOT)
