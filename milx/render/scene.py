"""Scene, Frame and Renderer: from an MJX state to an image.

The camera looks along its -z axis, x to the right and y up. `G` denotes all geoms of the model and `L` all its lights,
in MuJoCo's order. The background is black, as in MuJoCo's renderer for a model without a skybox.
"""

import copy
import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core.mjx import mjx
from milx.render import images, meshes, normals, raycast, shade, textures
from milx.render.textures import Textures

_DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
_SPOT = int(mujoco.mjtLightType.mjLIGHT_SPOT)
# MuJoCo shows the geom groups 0, 1 and 2 unless told otherwise.
_SHOWN_GROUPS = 3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """What can vary from frame to frame, in world coordinates.

    A geom whose alpha is 0 is not seen and casts no shadow; any other alpha is opaque.
    """

    geom_xpos: jax.Array  # [G, 3] m
    geom_xmat: jax.Array  # [G, 3, 3]
    geom_size: jax.Array  # [G, 3] m
    geom_rgba: jax.Array  # [G, 4]
    cam_xpos: jax.Array  # [3] m
    cam_xmat: jax.Array  # [3, 3]
    light_xpos: jax.Array  # [L, 3] m; lights that the model has switched off stay off
    light_xdir: jax.Array  # [L, 3] the way the light shines
    light_ambient: jax.Array  # [L, 3]
    light_diffuse: jax.Array  # [L, 3]
    light_specular: jax.Array  # [L, 3]
    headlight: jax.Array  # [3, 3] ambient, diffuse and specular color of the light that shines along the view
    texture: Textures | None = None  # [G] of every geom, with frames that take the world's; None for none


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Frame:
    """An image."""

    color: jax.Array  # [H, W, 3] in [0, 1]
    depth: jax.Array  # [H, W] m along the optical axis, infinite where nothing is hit
    geom_id: jax.Array  # [H, W] int32, MuJoCo's geom id, -1 where nothing is hit


def to_uint8(color: jax.Array) -> jax.Array:
    """Rounds colors in [0, 1] to uint8 in [0, 255]."""
    return jnp.round(255 * jnp.clip(color, 0.0, 1.0)).astype(jnp.uint8)


class Renderer:
    """Renders one camera of a model; pure functions to be used under `jax.jit` and `jax.vmap`.

    All geoms in groups 0 to 2 are rendered, as MuJoCo does by default. Near and far planes are MuJoCo's
    (`visual/map/znear` and `zfar`, in units of the model's extent). Meshes have MuJoCo's normals at their corners,
    interpolated, and those with texture coordinates their two-dimensional textures; MuJoCo's other textures are not
    drawn. The color is differentiable with respect to the colors and the lights; the geometry carries no gradient.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str | int,
        height: int,
        width: int,
        *,
        shadows: bool = False,
        max_triangles: int | None = None,
    ) -> None:
        """Prepares what does not change from frame to frame.

        Args:
            model: the model.
            camera: name or id of a perspective camera.
            height: of the image, in pixels.
            width: of the image, in pixels.
            shadows: whether lights with `castshadow` throw hard shadows; each costs about as much as all the rest.
            max_triangles: to how many larger meshes are simplified, as far as `decimate.py` can; None to keep all.

        Raises:
            ValueError: there is no such camera, or the model asks for what cannot be shown, or as `decimate.decimate`.
        """
        for name, value in (("height", height), ("width", width)):
            if value < 1:
                raise ValueError(f"{name}={value!r}: expected at least 1 pixel")
        if max_triangles is not None and max_triangles < 4:
            raise ValueError(f"max_triangles={max_triangles!r}: expected at least 4, or None")
        self.height, self.width = height, width
        self._model = model
        self._near, self._far = (float(edge * model.stat.extent) for edge in (model.vis.map.znear, model.vis.map.zfar))
        self._groups = _group_geoms(model)
        shown = self._groups.get(raycast.Kind.MESH)
        self._meshes = None if shown is None else meshes.of_model(model, shown, max_triangles)
        self._images = None if shown is None else images.of_model(model, shown)
        _check_lights(model)
        self._shadows = shadows
        self._materials = _materials(model)
        self._aim(camera)

    def _aim(self, camera: str | int) -> None:
        height, width = self.height, self.width
        self._camera = _find_camera(self._model, camera)
        self._tangent = float(np.tan(np.deg2rad(self._model.cam_fovy[self._camera]) / 2))
        x = (2 * (np.arange(width) + 0.5) / width - 1) * self._tangent * width / height
        y = (1 - 2 * (np.arange(height) + 0.5) / height) * self._tangent
        x, y = np.meshgrid(x, y)
        self._rays = (x.ravel(), y.ravel(), np.array(-1.0))

    def with_camera(self, camera: str | int) -> "Renderer":
        """Returns a renderer of another camera, which shares all that does not depend on the camera.

        Raises:
            ValueError: there is no such camera, or it cannot be shown.
        """
        other = copy.copy(self)
        other._aim(camera)
        return other

    def scene(self, data: mjx.Data | mujoco.MjData, model: mjx.Model | None = None) -> Scene:
        """Returns the scene that the data describes: poses from the data; colors, sizes and lights from the model.

        Args:
            data: a state after `kinematics`, `com_pos` and `camlight`, or after `forward` or `step`.
            model: whose `geom_size`, `geom_rgba`, `mat_rgba`, `light_pos`, `light_dir`, `light_ambient`,
                `light_diffuse` and `light_specular` count; those of the renderer's model by default.
        """
        own, model = self._model, self._model if model is None else model

        def array(values, *shape: int) -> jax.Array:
            return jnp.asarray(values, float).reshape(shape)

        # MJX keeps no light poses. Lights are fixed to their bodies, so they follow from those.
        body_xpos = array(data.xpos, -1, 3)[own.light_bodyid]
        body_xmat = array(data.xmat, -1, 3, 3)[own.light_bodyid]
        return Scene(
            geom_xpos=array(data.geom_xpos, -1, 3),
            geom_xmat=array(data.geom_xmat, -1, 3, 3),
            geom_size=array(model.geom_size, -1, 3),
            geom_rgba=_geom_rgba(own.geom_matid, array(model.geom_rgba, -1, 4), array(model.mat_rgba, -1, 4)),
            cam_xpos=array(data.cam_xpos[self._camera], 3),
            cam_xmat=array(data.cam_xmat[self._camera], 3, 3),
            light_xpos=body_xpos + _rotate(body_xmat, array(model.light_pos, -1, 3)),
            light_xdir=_rotate(body_xmat, array(model.light_dir, -1, 3)),
            light_ambient=array(model.light_ambient, -1, 3),
            light_diffuse=array(model.light_diffuse, -1, 3),
            light_specular=array(model.light_specular, -1, 3),
            headlight=array(shade.headlight(own), 3, 3),
        )

    def render(self, scene: Scene) -> Frame:
        """Draws the image of a scene."""
        maps = raycast.unit_maps(self._model.geom_type, *_geometry(scene))
        visible = scene.geom_rgba[:, 3] > 0
        rays = tuple(jnp.asarray(ray, scene.geom_xpos.dtype) for ray in self._rays)
        geom_id, distance = raycast.nearest(self._groups, maps, visible, rays, self._near, self._far, self._meshes)
        hit = geom_id >= 0
        # Where nothing is hit any finite point will do, but infinity would turn into NaN in the gradients.
        point = tuple(jnp.where(hit, distance, 1.0) * ray for ray in rays)
        winner = jnp.maximum(geom_id, 0)
        normal, texcoord = normals.at_points(self._groups, maps, winner, point, self._meshes)

        rgba, made_of = scene.geom_rgba[winner], jnp.asarray(self._materials, float)[winner]
        rgb = tuple(rgba[:, i] for i in range(3))
        if scene.texture is not None:
            family, second, frame = jax.tree.map(lambda x: x[winner], _in_camera(scene.texture, scene))
            rows = tuple(tuple(frame[:, i, j] for j in range(4)) for i in range(3))
            rgb = textures.mix(rgb, family, tuple(second[:, i] for i in range(3)), rows, point)
        material = shade.Material(rgb, *(made_of[:, i] for i in range(3)))
        color = shade.emitted(material)
        for casts, lights in self._lights(scene).items():
            shadow = partial(self._in_shadow, maps, visible, point) if casts else None
            added = shade.reflected(lights, material, point, normal, shadow)
            color = tuple(before + more for before, more in zip(color, added, strict=True))
        color = tuple(jnp.clip(channel, 0.0, 1.0) for channel in color)
        if self._images is not None and texcoord is not None:
            color = images.mix(self._images, color, winner, texcoord)
        shape = (self.height, self.width)
        return Frame(
            color=jnp.stack([jnp.where(hit, channel, 0.0).reshape(shape) for channel in color], axis=-1),
            depth=distance.reshape(shape),
            geom_id=geom_id.reshape(shape),
        )

    def pixels(self, scene: Scene) -> jax.Array:
        """Draws the image alone, [H, W, 3] uint8, without gradients.

        On a GPU it is one kernel if no shadows fall and no mesh shows a texture.
        """
        if jax.default_backend() != "gpu" or self._shadows or self._images is not None:
            return to_uint8(self.render(scene).color)
        return self.paint(scene)

    def paint(self, scene: Scene, interpret: bool = False) -> jax.Array:
        """Draws the image in one kernel of a GPU, without shadows; `interpret` runs the kernel anywhere, slowly.

        Raises:
            ValueError: if shadows are to fall, or a mesh shows a texture, which the kernel does not know.
        """
        if self._shadows or self._images is not None:
            raise ValueError("got shadows, or meshes with textures, expected neither: use render")
        from milx.render import kernel  # Pallas takes a quarter of a second to import

        texture = None if scene.texture is None else _in_camera(scene.texture, scene)
        looks = scene.geom_rgba, self._materials, texture, self._meshes
        geoms = kernel.geom_table(self._model.geom_type, _geometry(scene), *looks)
        order: list[int] = []
        ranges = {}
        for kind, ids in self._groups.items():
            ranges[kind] = (len(order), len(order) + len(ids))
            order += ids.tolist()
        lights = kernel.light_table(self._lights(scene)[False])
        view = kernel.View(self.height, self.width, self._tangent, self._near, self._far)
        return kernel.paint(geoms[np.array(order)], lights, ranges, view, self._meshes, interpret)

    def _in_shadow(self, maps, visible, point, path, w) -> jax.Array:
        """Tells whether a geom stands between the points and a light: [P] bool."""
        path = jax.lax.stop_gradient(path)
        reach = jnp.where(w > 0, 1.0, self._far)
        return raycast.blocked(self._groups, maps, visible, point, path, reach, self._meshes)

    def _lights(self, scene: Scene) -> dict[bool, shade.Lights]:
        """Groups the lights, in the camera frame, by whether they cast shadows; the headlight, last, casts none."""
        model = self._model
        to_camera = jax.lax.stop_gradient(scene.cam_xmat).T
        directional = (model.light_type == _DIRECTIONAL)[:, None]
        spot = (model.light_type == _SPOT) & (model.light_cutoff < 180)
        direction = _rotate(to_camera, scene.light_xdir)
        direction = direction / jnp.maximum(jnp.linalg.norm(direction, axis=1, keepdims=True), 1e-6)
        position = _rotate(to_camera, scene.light_xpos - jax.lax.stop_gradient(scene.cam_xpos))
        lights = shade.Lights(
            ambient=scene.light_ambient,
            diffuse=scene.light_diffuse,
            specular=scene.light_specular,
            direction=direction,
            position=jnp.concatenate([jnp.where(directional, -direction, position), ~directional], axis=1),
            attenuation=jnp.where(directional, jnp.array([1.0, 0.0, 0.0]), model.light_attenuation),
            cutoff=jnp.where(spot, np.cos(np.deg2rad(model.light_cutoff)), -2.0),
            exponent=jnp.where(spot, model.light_exponent, 0.0),
        )
        ambient, diffuse, specular = scene.headlight[:, None]
        ahead = jnp.array([[0.0, 0.0, -1.0]])
        behind = jnp.array([[0.0, 0.0, 1.0, 0.0]])
        plain = jnp.array([[1.0, 0.0, 0.0]])
        headlight = shade.Lights(ambient, diffuse, specular, ahead, behind, plain, jnp.array([-2.0]), jnp.array([0.0]))
        active, casts = model.light_active.astype(bool), model.light_castshadow.astype(bool) & self._shadows
        others = jax.tree.map(lambda a, b: jnp.concatenate([a[active & ~casts], b]), lights, headlight)
        if not (active & casts).any():
            return {False: others}
        return {False: others, True: jax.tree.map(lambda a: a[active & casts], lights)}


def _geometry(scene: Scene) -> tuple[jax.Array, ...]:
    """Returns the poses and sizes of the geoms and the camera's pose, without gradients."""
    return jax.lax.stop_gradient((scene.geom_xpos, scene.geom_xmat, scene.geom_size, scene.cam_xpos, scene.cam_xmat))


def _in_camera(texture: Textures, scene: Scene) -> Textures:
    """Expresses the textures' frames in the camera's."""
    pose = jax.lax.stop_gradient((scene.cam_xpos, scene.cam_xmat))
    return texture._replace(frame=textures.seen_from(jax.lax.stop_gradient(texture.frame), *pose))


def _rotate(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Multiplies matrices [..., 3, 3] by vectors [..., 3], in full precision on every device."""
    return jnp.einsum("...ij,...j->...i", matrix, vector, precision=jax.lax.Precision.HIGHEST)


def _geom_rgba(material: np.ndarray, rgba: jax.Array, of_materials: jax.Array) -> jax.Array:
    """Returns [G, 4] colors. As in MuJoCo, a geom that keeps the default color takes its material's."""
    has = material >= 0
    if not has.any():
        return rgba
    takes = has & jnp.all(rgba == jnp.array([0.5, 0.5, 0.5, 1.0]), axis=1)
    return jnp.where(takes[:, None], of_materials[np.where(has, material, 0)], rgba)


def _materials(model: mujoco.MjModel) -> np.ndarray:
    """Returns [G, 3] emission, specular and shininess; MuJoCo's defaults where there is no material."""
    values = np.tile([0.0, 0.5, 0.5], (model.ngeom, 1))
    has = model.geom_matid >= 0
    table = np.stack([model.mat_emission, model.mat_specular, model.mat_shininess], axis=1)
    values[has] = table[model.geom_matid[has]]
    return values


def _find_camera(model: mujoco.MjModel, camera: str | int) -> int:
    """Finds the id of a camera that this renderer can show.

    Raises:
        ValueError: there is no such camera, or it is not given by `fovy` alone.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if isinstance(camera, str) and camera in names:
        camera = names.index(camera)
    if isinstance(camera, str) or not 0 <= camera < model.ncam:
        raise ValueError(f"camera={camera!r}: expected one of {names} or an id in [0, {model.ncam})")
    if int(model.cam_projection[camera]) != int(mujoco.mjtProjection.mjPROJ_PERSPECTIVE):
        raise ValueError(f"cam_projection={model.cam_projection[camera]} of camera {camera}: expected perspective")
    if model.cam_sensorsize[camera].any():
        raise ValueError(f"cam_sensorsize={model.cam_sensorsize[camera]} of camera {camera}: expected none, but fovy")
    return camera


def _group_geoms(model: mujoco.MjModel) -> dict[raycast.Kind, np.ndarray]:
    """Groups the ids of the shown geoms by kind, the largest group last as `raycast.nearest` prefers.

    Raises:
        ValueError: a shown geom is neither a primitive nor a mesh, or no geom is shown.
    """
    kinds: dict[raycast.Kind, list[int]] = {}
    for i in np.flatnonzero(model.geom_group < _SHOWN_GROUPS):
        geom_type = int(model.geom_type[i])
        if geom_type not in raycast.KIND_OF_GEOM:
            name = mujoco.mjtGeom(geom_type).name
            raise ValueError(
                f"geom_type={name} of geom {i} {model.geom(i).name!r}: expected a plane, sphere, capsule, ellipsoid, "
                f"cylinder, box or mesh, or a geom_group of {_SHOWN_GROUPS} or more, which is not shown"
            )
        kinds.setdefault(raycast.KIND_OF_GEOM[geom_type], []).append(int(i))
    if not kinds:
        raise ValueError(f"geom_group={model.geom_group}: expected a geom in a group below {_SHOWN_GROUPS}")
    return {kind: np.array(kinds[kind]) for kind in sorted(kinds, key=lambda kind: len(kinds[kind]))}


def _check_lights(model: mujoco.MjModel) -> None:
    """Refuses what the shading does not cover.

    Raises:
        ValueError: an image light, or a light that tracks a body instead of being fixed to its own.
    """
    for i in range(model.nlight):
        if int(model.light_type[i]) == int(mujoco.mjtLightType.mjLIGHT_IMAGE):
            raise ValueError(f"light_type=mjLIGHT_IMAGE of light {i}: expected spot, directional or point")
        if int(model.light_mode[i]) != int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED):
            mode = mujoco.mjtCamLight(int(model.light_mode[i])).name
            raise ValueError(f"light_mode={mode} of light {i}: expected mjCAMLIGHT_FIXED")
