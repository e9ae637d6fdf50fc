"""The shaders of splats: one draws each splat as an ellipse into a picture, the other draws that picture over the
viewport.

The picture contains colour as in photos (sRGB, blended as such, like the Gaussians were trained) in half floats;
Blender's viewport blends in linear light with eight bits, which would wash out hundreds of faint splats.

Gaussians are projected as in `engine/splatting/kernels/project.py`: covariance J V Σ Vᵀ Jᵀ + 0.3 I in px², α up to
0.99, nothing below 1/255, which is slightly more than three standard deviations. Nothing here runs in background mode.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..blender_data import linear_from_srgb
from ..viewport.gaussian_nodes import PROBABILITY_RAMP, RAMP_START

if TYPE_CHECKING:
    import gpu

# Values shared by all splats of an object: more than cards guarantee as push constants.
_VALUES = """
struct SplatValues {
  mat4 model_view;
  mat4 projection;
  vec2 size;
  float nearest;
  float threshold;
  float dimming;
  float highlight;
  float antialiased;
  float row;
};
"""

# texel(i) of a texture stored row by row.
_TEXEL = "ivec2 texel(int index) { int row = int(values.row); return ivec2(index % row, index / row); }"

_VERTEX = """
void main()
{
  int index = int(texelFetch(order, texel(gl_InstanceID), 0).r + 0.5);
  vec4 place = texelFetch(places, texel(index), 0);
  vec4 upper = texelFetch(upper_shapes, texel(index), 0);
  vec2 lower = texelFetch(lower_shapes, texel(index), 0).rg;
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  offset = vec2(0.0);
  shade = vec4(0.0);

  vec4 seen = values.model_view * vec4(place.xyz, 1.0);
  vec4 clip = values.projection * seen;
  if (-seen.z < values.nearest) {
    return;
  }
  vec2 screen = clip.xy / clip.w;
  /* The derivative of the projection to pixels, taken no farther outside than the linearisation holds. */
  vec2 held = clamp(screen, vec2(-1.3), vec2(1.3));
  mat4 rows = transpose(values.projection);
  vec3 jx = 0.5 * values.size.x / clip.w * (rows[0].xyz - held.x * rows[3].xyz);
  vec3 jy = 0.5 * values.size.y / clip.w * (rows[1].xyz - held.y * rows[3].xyz);
  mat3 back = transpose(mat3(values.model_view));
  vec3 ax = back * jx;
  vec3 ay = back * jy;
  mat3 covariance = mat3(upper.x, upper.y, upper.z, upper.y, upper.w, lower.x, upper.z, lower.x, lower.y);
  vec3 cx = covariance * ax;
  float xx = dot(ax, cx);
  float xy = dot(ay, cx);
  float yy = dot(ay, covariance * ay);
  float narrow = max(xx * yy - xy * xy, 0.0);
  xx += 0.3;
  yy += 0.3;
  float whole = max(xx * yy - xy * xy, 0.09);
  float opacity = place.w;
  if (values.antialiased != 0.0) {
    opacity *= max(sqrt(narrow / whole), 1e-6);
  }
  if (opacity < 1.0 / 255.0 || max(xx, yy) > 1e12) {
    return;
  }
  /* Half axes of the ellipse in which α is at least 1/255. */
  float middle = 0.5 * (xx + yy);
  float spread = sqrt(max(0.25 * (xx - yy) * (xx - yy) + xy * xy, 0.0));
  float long_one = middle + spread;
  float short_one = max(whole / long_one, 1e-6);
  vec2 along = abs(xy) > 1e-6 ? normalize(vec2(xy, long_one - xx)) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float deviations = sqrt(2.0 * log(255.0 * opacity));
  offset = corner * deviations;
  vec2 pixels = offset.x * sqrt(long_one) * along + offset.y * sqrt(short_one) * vec2(-along.y, along.x);
  gl_Position = vec4(screen + 2.0 * pixels / values.size, clip.z / clip.w, 1.0);

  vec3 color = texelFetch(colors, texel(index), 0).rgb;
  if (values.highlight != 0.0) {
    float probability = texelFetch(likely, texel(index), 0).r;
    if (probability >= values.threshold) {
      float above = (probability - values.threshold) / max(1.0 - values.threshold, 1e-6);
      vec4 ramp = probability_ramp(RAMP_START + (1.0 - RAMP_START) * above);
      color = mix(color, ramp.rgb, ramp.a);
    }
    else {
      color *= 1.0 - values.dimming;
    }
  }
  vec3 srgb = mix(12.92 * color, 1.055 * pow(max(color, vec3(1e-8)), vec3(1.0 / 2.4)) - 0.055,
                  vec3(greaterThan(color, vec3(0.0031308))));
  shade = vec4(srgb, opacity);
}
"""

_FRAGMENT = """
void main()
{
  /* Behind what Blender has drawn; its depths are of the same projection. */
  if (gl_FragCoord.z > texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r) {
    discard;
  }
  float alpha = min(shade.a * exp(-0.5 * dot(offset, offset)), 0.99);
  if (alpha < 1.0 / 255.0) {
    discard;
  }
  result = vec4(shade.rgb * alpha, alpha);
}
"""

_OVER_VERTEX = "void main() { gl_Position = vec4(corner, 0.0, 1.0); }"

_OVER_FRAGMENT = """
void main()
{
  vec4 splats = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  if (splats.a <= 0.0) {
    discard;
  }
  /* What is drawn over a viewport is shown as its 2.2nd root. */
  float alpha = splats.a * strength;
  result = vec4(pow(max(splats.rgb / splats.a, vec3(0.0)), vec3(2.2)) * alpha, alpha);
}
"""


def ramp_source() -> str:
    """GLSL of the ramp of `gaussian_nodes.PROBABILITY_RAMP`: linear colour, and how much it replaces the Gaussian's
    colour."""
    stops = [(position, (*linear_from_srgb(srgb).tolist(), cover)) for position, srgb, cover in PROBABILITY_RAMP]
    lines = ["vec4 probability_ramp(float at) {", f"  vec4 found = {_vec4(stops[0][1])};"]
    for (low, _), (high, color) in pairwise(stops):
        share = f"clamp((at - {low:.6f}) / {high - low:.6f}, 0.0, 1.0)"
        lines.append(f"  found = mix(found, {_vec4(color)}, {share});")
    return "\n".join([*lines, "  return found;", "}"])


def _vec4(values: Any) -> str:
    return f"vec4({', '.join(f'{value:.6f}' for value in values)})"


def pack_values(
    model_view: Matrix,
    projection: Matrix,
    size: tuple[int, int],
    *,
    nearest: float,
    threshold: float,
    dimming: float,
    highlight: bool,
    antialiased: bool,
    row: int,
) -> NDArray[np.float32]:
    """Pack the numbers (40,) of `SplatValues`, matrices by columns.

    size: of the picture in px; nearest: depth in world units up to which nothing is drawn; row: width of the data
    textures.
    """
    matrices = [np.array(matrix, np.float32).T.ravel() for matrix in (model_view, projection)]
    rest = (*size, nearest, threshold, dimming, highlight, antialiased, row)
    return np.concatenate([*matrices, np.array(rest, np.float32)])


def splat_shader() -> gpu.types.GPUShader:
    """The shader that draws one splat per instance, with the values of `pack_values`."""
    import gpu

    between = gpu.types.GPUStageInterfaceInfo("fruitlangs_splat")
    between.smooth("VEC2", "offset")
    between.flat("VEC4", "shade")
    info = gpu.types.GPUShaderCreateInfo()
    info.typedef_source(_VALUES)
    info.uniform_buf(0, "SplatValues", "values")
    for slot, name in enumerate(("order", "places", "upper_shapes", "lower_shapes", "colors", "likely", "depths")):
        info.sampler(slot, "FLOAT_2D", name)
    info.define("RAMP_START", f"{RAMP_START:.6f}")
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(between)
    info.fragment_out(0, "VEC4", "result")
    info.vertex_source("\n".join((_TEXEL, ramp_source(), _VERTEX)))
    info.fragment_source(_FRAGMENT)
    return gpu.shader.create_from_info(info)


def over_shader() -> gpu.types.GPUShader:
    """The shader that draws the picture of the splats over the viewport."""
    import gpu

    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("FLOAT", "strength")
    info.sampler(0, "FLOAT_2D", "picture")
    info.vertex_in(0, "VEC2", "corner")
    info.fragment_out(0, "VEC4", "result")
    info.vertex_source(_OVER_VERTEX)
    info.fragment_source(_OVER_FRAGMENT)
    return gpu.shader.create_from_info(info)
