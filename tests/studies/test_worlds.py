"""The renderer of the studies' worlds, on a box that is built here."""

import math
import struct

import cv2
import numpy as np
import omg
import pytest
from worlds import cubes, geometry, poses, render, scene, textures, wad

from darswin import Rig
from darswin.lens import Equidistant, Perspective, Spherical
from darswin.views import CameraView

LABEL = geometry.LABEL


def box_wad() -> omg.WAD:
    """Of 512 × 256 × 128 units with a step of 16 in its eastern half. The wall's texture has one
    colour a quarter, flats are even."""
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
    ways = np.array([eye(0, 32, 100), eye(0, 96, 100), eye(0, 32, 30), eye(0, 96, 30)]) - at
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


def test_a_cube_is_what_a_fisheye_sees(box, tmp_path, monkeypatch):
    pose = poses.Pose(eye(300, 100, 60), poses.look(0.7, 0.2, -0.1))
    for name, value in dict(load_map=(0, 0), Textures=0, Scene=box, poses_of=[pose]).items():
        monkeypatch.setattr(cubes, name, lambda *_, value=value: value)
    cubes.write_cubes("box-MAP01", "val", tmp_path, 64, 1, 0)

    def faces(kind: str) -> dict:
        files = {name: f"{tmp_path}/val/{kind}/{name}/box-MAP01-000.png" for name in rig.names}
        return {name: cv2.imread(file, cv2.IMREAD_UNCHANGED) for name, file in files.items()}

    lens, rig = Equidistant(12.0, theta_max=math.radians(100), image_size=(48, 48)), Rig.cube(64)
    remap, true = CameraView(lens).at(rig), render.render(box, pose, render.rays_of(lens))
    assert (remap.target(faces("labels")) == true.labels).mean() > 0.98
    far = remap.depth({name: z / cubes.DEPTH_UNIT for name, z in faces("depth").items()})
    off = np.abs(far / np.where(true.distance > 0, true.distance, np.nan) - 1)
    assert np.nanmedian(off) < 1e-3 and np.nanquantile(off, 0.9) < 0.01
    apart = np.abs(remap(faces("colour"))[..., ::-1].astype(float) - true.image)
    assert np.median(apart) < 3


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
