// Rays by Embree, and pictures.
#include <dlfcn.h>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "compute/parallel.h"
#include "core/checksum.h"
#include "core/error.h"
#include "core/files.h"
#include "core/rng.h"
#include "datasets/obj_room/obj_room.h"
#include "formats/image_io.h"
#include "scene/loading/packed_scene.h"

#ifdef SEMFIELD_WITH_RAYCAST
#if SEMFIELD_EMBREE == 3
#include <embree3/rtcore.h>
#else
#include <embree4/rtcore.h>
#endif
#endif

namespace semfield {

namespace {

Vec3d to_double(Vec3f v) { return {v.x, v.y, v.z}; }
Vec3f to_float(Vec3d v) { return {static_cast<float>(v.x), static_cast<float>(v.y), static_cast<float>(v.z)}; }

}  // namespace

// Embree scene (version 3 or 4): one geometry for opaque triangles, one with a filter for cut-outs.

#ifdef SEMFIELD_WITH_RAYCAST

bool raycast_available() { return true; }

struct Raycaster::Impl {
  const TriangleMesh& mesh;
  OpaqueTest opaque;
  RTCDevice device = nullptr;
  RTCScene scene = nullptr;
  std::vector<std::int64_t> triangle_of[2];  // geometry 0: opaque, 1: cut-outs

  explicit Impl(const TriangleMesh& m) : mesh(m) {}
  ~Impl() {
    if (scene != nullptr) rtcReleaseScene(scene);
    if (device != nullptr) rtcReleaseDevice(device);
  }

  static void filter(const RTCFilterFunctionNArguments* args) {
    const auto* impl = static_cast<const Impl*>(args->geometryUserPtr);
    for (unsigned i = 0; i < args->N; ++i) {
      if (args->valid[i] == 0) continue;
      const unsigned primitive = RTCHitN_primID(args->hit, args->N, i);
      const float b1 = RTCHitN_u(args->hit, args->N, i), b2 = RTCHitN_v(args->hit, args->N, i);
      if (!impl->opaque(impl->triangle_of[1][primitive], b1, b2)) args->valid[i] = 0;
    }
  }

  void add_geometry(unsigned id) {
    const std::vector<std::int64_t>& list = triangle_of[id];
    if (list.empty()) return;
    RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    auto* vertices = static_cast<float*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                                                 3 * sizeof(float), mesh.positions.size()));
    auto* indices = static_cast<unsigned*>(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                                                   3 * sizeof(unsigned), list.size()));
    if (vertices == nullptr || indices == nullptr) {
      rtcReleaseGeometry(geometry);
      throw Error(ErrorKind::unavailable, "memory.raycast.full", "not enough memory for the ray-casting scene",
                  "use a smaller mesh");
    }
    for (const Vec3f& p : mesh.positions)
      for (int k = 0; k < 3; ++k) *vertices++ = p[k];
    for (const std::int64_t triangle : list)
      indices = std::ranges::copy(mesh.triangles[static_cast<std::size_t>(triangle)], indices).out;
    if (id == 1) {
      rtcSetGeometryUserData(geometry, this);
      rtcSetGeometryIntersectFilterFunction(geometry, filter);
      rtcSetGeometryOccludedFilterFunction(geometry, filter);
    }
    rtcCommitGeometry(geometry);
    rtcAttachGeometryByID(scene, geometry, id);
    rtcReleaseGeometry(geometry);
  }
};

Raycaster::Raycaster(const TriangleMesh& mesh, std::vector<bool> cut_out, OpaqueTest opaque)
    : impl_(std::make_unique<Impl>(mesh)) {
  // One build thread: the tree, and with it the choice between coincident surfaces, is the same on every machine size.
  impl_->device = rtcNewDevice("threads=1");
  if (impl_->device == nullptr)
    throw Error(ErrorKind::unavailable, "system.embree.failed",
                "Embree cannot start (error " + std::to_string(rtcGetDeviceError(nullptr)) + ")");
  impl_->opaque = std::move(opaque);
  impl_->scene = rtcNewScene(impl_->device);
  rtcSetSceneFlags(impl_->scene, RTC_SCENE_FLAG_ROBUST);
  rtcSetSceneBuildQuality(impl_->scene, RTC_BUILD_QUALITY_HIGH);
  for (std::size_t i = 0; i < mesh.size(); ++i) {
    const bool cut = i < cut_out.size() && cut_out[i] && impl_->opaque;
    impl_->triangle_of[cut ? 1 : 0].push_back(static_cast<std::int64_t>(i));
  }
  impl_->add_geometry(0);
  impl_->add_geometry(1);
  rtcCommitScene(impl_->scene);
  if (rtcGetDeviceError(impl_->device) != RTC_ERROR_NONE)
    throw Error(ErrorKind::unavailable, "memory.raycast.full", "Embree cannot build the ray-casting scene",
                "use a smaller mesh");
}

namespace {

RTCRay ray_of(Vec3d origin, Vec3d direction, double max_m) {
  const Vec3f o = to_float(origin), d = to_float(direction);
  // Origin and the least distance, direction and time, the greatest distance, mask, id and flags.
  return {o.x, o.y, o.z, 0, d.x, d.y, d.z, 0, static_cast<float>(max_m), ~0u, 0, 0};
}

// rtcIntersect1 or rtcOccluded1; Embree 4 has no contexts any more.
template <class Call, class Ray>
void cast(const Call& call, RTCScene scene, Ray& ray) {
#if SEMFIELD_EMBREE == 3
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  call(scene, &context, &ray);
#else
  call(scene, &ray, nullptr);
#endif
}

}  // namespace

RayHit Raycaster::trace(Vec3d origin, Vec3d direction, double max_m) const {
  RTCRayHit ray{};
  ray.ray = ray_of(origin, direction, max_m);
  ray.hit.geomID = RTC_INVALID_GEOMETRY_ID;
  cast(rtcIntersect1, impl_->scene, ray);
  RayHit hit;
  if (ray.hit.geomID == RTC_INVALID_GEOMETRY_ID) return hit;
  hit.triangle = impl_->triangle_of[ray.hit.geomID][ray.hit.primID];
  hit.b1 = ray.hit.u;
  hit.b2 = ray.hit.v;
  // Float32 tells which triangle; its plane in float64 tells how far.
  const auto triangle = static_cast<std::size_t>(hit.triangle);
  const Vec3d normal = impl_->mesh.cross_of_sides(triangle);
  const double along = dot(normal, direction);
  const double exact = along != 0 ? dot(normal, impl_->mesh.corner(triangle, 0) - origin) / along : ray.ray.tfar;
  // Grazing rays have no stable plane distance.
  hit.distance_m = std::abs(exact - ray.ray.tfar) < 1e-3 * (1 + std::abs(exact)) ? exact : ray.ray.tfar;
  return hit;
}

bool Raycaster::blocked(Vec3d origin, Vec3d direction, double max_m) const {
  RTCRay ray = ray_of(origin, direction, max_m);
  cast(rtcOccluded1, impl_->scene, ray);
  return ray.tfar < 0;
}

namespace {

// Nearest point of triangle abc to p, by Voronoi regions [Ericson05, sec. 5.1.5].
Vec3d nearest_on_triangle(Vec3d p, Vec3d a, Vec3d b, Vec3d c) {
  const Vec3d ab = b - a, ac = c - a, ap = p - a;
  const double d1 = dot(ab, ap), d2 = dot(ac, ap);
  if (d1 <= 0 && d2 <= 0) return a;
  const Vec3d bp = p - b;
  const double d3 = dot(ab, bp), d4 = dot(ac, bp);
  if (d3 >= 0 && d4 <= d3) return b;
  const double vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return a + ab * (d1 / (d1 - d3));
  const Vec3d cp = p - c;
  const double d5 = dot(ab, cp), d6 = dot(ac, cp);
  if (d6 >= 0 && d5 <= d6) return c;
  const double vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return a + ac * (d2 / (d2 - d6));
  const double va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
  const double sum = va + vb + vc;
  return a + ab * (vb / sum) + ac * (vc / sum);
}

struct Nearest {
  const TriangleMesh* mesh;
  const std::vector<std::int64_t>* triangle_of;
  Vec3d point;
  double distance;
};

bool nearest_callback(RTCPointQueryFunctionArguments* args) {
  auto& nearest = *static_cast<Nearest*>(args->userPtr);
  const TriangleMesh& mesh = *nearest.mesh;
  const auto t = static_cast<std::size_t>(nearest.triangle_of[args->geomID][args->primID]);
  const Vec3d on = nearest_on_triangle(nearest.point, mesh.corner(t, 0), mesh.corner(t, 1), mesh.corner(t, 2));
  const double distance = length(on - nearest.point);
  if (distance >= nearest.distance) return false;
  nearest.distance = distance;
  args->query->radius = static_cast<float>(distance * 1.0001);
  return true;
}

}  // namespace

double Raycaster::clearance(Vec3d point, double limit_m) const {
  Nearest nearest{&impl_->mesh, impl_->triangle_of, point, limit_m};
  RTCPointQuery query{};
  query.x = static_cast<float>(point.x);
  query.y = static_cast<float>(point.y);
  query.z = static_cast<float>(point.z);
  query.radius = static_cast<float>(limit_m * 1.0001);
  RTCPointQueryContext context;
  rtcInitPointQueryContext(&context);
  rtcPointQuery(impl_->scene, &query, &context, nearest_callback, &nearest);
  return nearest.distance;
}

#else

bool raycast_available() { return false; }

struct Raycaster::Impl {};

Raycaster::Raycaster(const TriangleMesh&, std::vector<bool>, OpaqueTest) {
  throw Error(ErrorKind::unavailable, "scene.obj.unsupported", "this build cannot cast rays",
              "configure with -DSEMFIELD_WITH_RAYCAST=ON (needs Embree 3 or 4)");
}
RayHit Raycaster::trace(Vec3d, Vec3d, double) const { return {}; }
bool Raycaster::blocked(Vec3d, Vec3d, double) const { return false; }
double Raycaster::clearance(Vec3d, double) const { return 0; }

#endif

Raycaster::~Raycaster() = default;

// Shading: interleaved sampling of the light, smoothed over pixels that show the same surface [Keller01].

namespace {

constexpr double kTwoPi = 6.283185307179586;
constexpr int kLattice = 32;
constexpr double kNoTextureCell_m = 0.35;

double radical_inverse2(std::uint32_t k) {
  k = (k << 16) | (k >> 16);
  k = ((k & 0x00ff00ffu) << 8) | ((k & 0xff00ff00u) >> 8);
  k = ((k & 0x0f0f0f0fu) << 4) | ((k & 0xf0f0f0f0u) >> 4);
  k = ((k & 0x33333333u) << 2) | ((k & 0xccccccccu) >> 2);
  k = ((k & 0x55555555u) << 1) | ((k & 0xaaaaaaaau) >> 1);
  return static_cast<double>(k) * 0x1p-32;
}

// Hammersley point of a set of n, jittered within its stratum.
void spread_sample(int k, int n, const PhiloxBlock& jitter, double& a, double& b) {
  a = (k + static_cast<double>(jitter.v[0]) * 0x1p-32) / n;
  b = radical_inverse2(static_cast<std::uint32_t>(k)) + static_cast<double>(jitter.v[1]) * 0x1p-32 / n;
  if (b >= 1) b -= 1;
}

// Two unit vectors that complete n to a frame [Duff17].
void frame_of(Vec3d n, Vec3d& s, Vec3d& t) {
  const double sign = std::copysign(1.0, n.z);
  const double a = -1.0 / (sign + n.z), b = n.x * n.y * a;
  s = {1 + sign * n.x * n.x * a, sign * b, -sign * n.x};
  t = {b, sign + n.y * n.y * a, -n.y};
}

std::array<float, 3> pastel(const RandomAddress& address, std::uint64_t index) {
  const float hue = uniform01(address, 3 * index) * 6.0f;
  const float saturation = 0.25f + 0.4f * uniform01(address, 3 * index + 1);
  const float value = 0.35f + 0.4f * uniform01(address, 3 * index + 2);
  std::array<float, 3> out{};
  for (int c = 0; c < 3; ++c) {
    const float k = std::fmod(hue + static_cast<float>(5 - 2 * c), 6.0f);
    out[static_cast<std::size_t>(c)] = value * (1 - saturation * std::clamp(std::min(k, 4 - k), 0.0f, 1.0f));
  }
  return out;
}

}  // namespace

MeshRenderer::MeshRenderer(TriangleMesh mesh, std::vector<std::int16_t> class_of, RenderSettings settings,
                           Diagnostics& diagnostics)
    : mesh_(std::move(mesh)), class_of_(std::move(class_of)), settings_(std::move(settings)) {
  prepare_materials(diagnostics);
  std::vector<bool> cut_out(mesh_.size());
  for (std::size_t i = 0; i < mesh_.size(); ++i) cut_out[i] = look(i).mask != nullptr || look(i).is_open();
  rays_ = std::make_unique<Raycaster>(mesh_, std::move(cut_out),
                                      [this](std::int64_t t, float b1, float b2) { return opaque(t, b1, b2); });
}

void MeshRenderer::prepare_materials(Diagnostics& diagnostics) {
  const auto load = [&](const std::string& path, auto& known) {
    const auto [at, fresh] = known.try_emplace(path);
    auto& image = at->second;
    try {
      if (fresh && !path.empty()) image = std::decay_t<decltype(*image)>::load(path);
    } catch (const Error& error) {
      diagnostics.warning("scene.obj.texture", path, "texture cannot be read: " + error.message(),
                          "the plain colour is used");
    }
    return image ? &*image : nullptr;
  };
  for (const Material& material : mesh_.materials)
    looks_.push_back({&material, load(material.diffuse_map, textures_), load(material.opacity_map, masks_)});
  texels_per_m_.assign(mesh_.size(), 0);
  for (std::size_t i = 0; i < mesh_.size(); ++i) {
    const Texture* const texture = look(i).texture;
    if (texture == nullptr) continue;
    const auto& uv = mesh_.uv[i];
    const double area_uv =
        std::abs((uv[1][0] - uv[0][0]) * (uv[2][1] - uv[0][1]) - (uv[1][1] - uv[0][1]) * (uv[2][0] - uv[0][0]));
    const double area_m = length(mesh_.cross_of_sides(i));
    texels_per_m_[i] = static_cast<float>(std::sqrt(area_uv * texture->width() * texture->height() / area_m));
  }
  const RandomAddress colors{settings_.seed, 0, stream_id("mesh/object_color")};
  for (std::size_t i = 0; i < mesh_.objects.size(); ++i) object_color_.push_back(pastel(colors, i));
  const RandomAddress cells{settings_.seed, 0, stream_id("mesh/lattice")};
  lattice_.resize(kLattice * kLattice * kLattice);
  for (std::size_t i = 0; i < lattice_.size(); ++i) lattice_[i] = uniform01(cells, i);
}

bool MeshRenderer::opaque(std::int64_t triangle, float b1, float b2) const {
  const auto i = static_cast<std::size_t>(triangle);
  if (look(i).is_open()) return false;
  const Mask* const mask = look(i).mask;
  const auto& uv = mesh_.uv[i];
  const float b0 = 1 - b1 - b2;
  return mask == nullptr ||
         mask->opaque(b0 * uv[0][0] + b1 * uv[1][0] + b2 * uv[2][0], b0 * uv[0][1] + b1 * uv[1][1] + b2 * uv[2][1]);
}

MeshRenderer::Surface MeshRenderer::surface(Vec3d origin, Vec3d direction) const {
  Surface s;
  const RayHit hit = rays_->trace(origin, direction);
  if (!hit.hit()) return s;
  const auto i = static_cast<std::size_t>(hit.triangle);
  s.triangle = hit.triangle;
  s.object = mesh_.object_of[i];
  s.distance_m = hit.distance_m;
  s.point = origin + direction * hit.distance_m;
  Vec3d facet = normalized(mesh_.cross_of_sides(i));
  const float b0 = 1 - hit.b1 - hit.b2;
  const auto& n = mesh_.normals[i];
  Vec3f smooth = n[0] * b0 + n[1] * hit.b1 + n[2] * hit.b2;
  Vec3d shading = dot(smooth, smooth) > 1e-6f ? normalized(to_double(smooth)) : facet;
  if (dot(facet, direction) > 0) facet = facet * -1.0;
  if (dot(shading, facet) < 0) shading = shading * -1.0;
  s.facet = to_float(facet);
  s.normal = to_float(shading);
  const auto& uv = mesh_.uv[i];
  s.u = b0 * uv[0][0] + hit.b1 * uv[1][0] + hit.b2 * uv[2][0];
  s.v = b0 * uv[0][1] + hit.b1 * uv[1][1] + hit.b2 * uv[2][1];
  return s;
}

// Value noise: trilinear between random values on a lattice of 1 unit, in [0, 1].
float MeshRenderer::noise(Vec3d p) const {
  const double f[3] = {std::floor(p.x), std::floor(p.y), std::floor(p.z)};
  int cell[3];
  float w[3];
  for (int k = 0; k < 3; ++k) {
    cell[k] = static_cast<int>(static_cast<std::int64_t>(f[k]) & (kLattice - 1));
    w[k] = static_cast<float>(p[k] - f[k]);
  }
  float sum = 0;
  for (int corner = 0; corner < 8; ++corner) {
    float weight = 1;
    int at[3];
    for (int k = 0; k < 3; ++k) {
      const int bit = (corner >> k) & 1;
      at[k] = (cell[k] + bit) & (kLattice - 1);
      weight *= bit != 0 ? w[k] : 1 - w[k];
    }
    sum += weight * lattice_[static_cast<std::size_t>((at[2] * kLattice + at[1]) * kLattice + at[0])];
  }
  return sum;
}

MeshRenderer::Color MeshRenderer::albedo(const Surface& s, double footprint_m) const {
  const auto i = static_cast<std::size_t>(s.triangle);
  const Look& own = look(i);
  if (own.material == nullptr) {
    // A file without materials still needs something to match between views: blotches in two sizes.
    const Color base = object_color_[static_cast<std::size_t>(s.object)];
    const Vec3d p = s.point * (1 / kNoTextureCell_m);
    const float value = 0.55f + 0.6f * noise(p) + 0.3f * noise(p * 4.0);
    return {base[0] * value, base[1] * value, base[2] * value};
  }
  if (own.texture == nullptr) return own.material->diffuse;
  const float level = std::log2(std::max(1e-6f, texels_per_m_[i] * static_cast<float>(footprint_m)));
  return own.texture->sample(s.u, s.v, level);
}

MeshRenderer::Color MeshRenderer::emission(const Surface& s, const Color& color) const {
  const Look& own = look(static_cast<std::size_t>(s.triangle));
  if (own.material == nullptr) return {};
  const Color& glow = own.material->emission;
  return own.texture == nullptr ? glow : Color{glow[0] * color[0], glow[1] * color[1], glow[2] * color[2]};
}

MeshRenderer::Color MeshRenderer::irradiance(const Surface& s, int pattern, std::uint64_t frame,
                                             std::uint64_t pixel) const {
  const Vec3d normal = to_double(s.normal);
  const Vec3d start = s.point + to_double(s.facet) * (2e-4 * (1 + s.distance_m * 0.1));
  const RandomAddress address{settings_.seed, frame, stream_id("mesh/irradiance")};
  Vec3d tangent, bitangent;
  frame_of(normal, tangent, bitangent);
  const int ao = settings_.occlusion_rays;
  int open = 0;
  std::uint64_t draw =
      pixel * static_cast<std::uint64_t>(ao + settings_.shadow_rays * static_cast<int>(settings_.lights.size()));
  for (int i = 0; i < ao; ++i) {
    double a = 0, b = 0;
    spread_sample(i * 16 + pattern, ao * 16, random_block(address, draw++), a, b);
    // Cosine-weighted hemisphere: r = sqrt(b), phi = 2 pi a.
    const double r = std::sqrt(b), up = std::sqrt(std::max(0.0, 1 - b)), phi = kTwoPi * a;
    const Vec3d d = tangent * (r * std::cos(phi)) + bitangent * (r * std::sin(phi)) + normal * up;
    if (dot(d, to_double(s.facet)) > 0 && !rays_->blocked(start, d, settings_.occlusion_m)) ++open;
  }
  const float sky = ao > 0 ? static_cast<float>(open) / static_cast<float>(ao) : 1.0f;
  const float side = 0.5f + 0.5f * static_cast<float>(dot(normal, settings_.up));
  Color out{};
  for (std::size_t c = 0; c < 3; ++c) {
    out[c] = sky * (settings_.ambient_below[c] + side * (settings_.ambient_above[c] - settings_.ambient_below[c]));
  }
  for (const Light& light : settings_.lights) {
    const int n = std::max(1, settings_.shadow_rays);
    for (int i = 0; i < n; ++i) {
      double a = 0, b = 0;
      spread_sample(i * 16 + pattern, n * 16, random_block(address, draw++), a, b);
      const double z = 1 - 2 * b, r = std::sqrt(std::max(0.0, 1 - z * z)), phi = kTwoPi * a;
      const Vec3d to = light.position + Vec3d{r * std::cos(phi), r * std::sin(phi), z} * light.radius_m - start;
      const double distance = length(to);
      const Vec3d d = to * (1 / std::max(distance, 1e-6));
      const double facing = dot(d, normal);
      if (facing <= 0 || dot(d, to_double(s.facet)) <= 0 || rays_->blocked(start, d, distance)) continue;
      // E = I cos / d^2, with d^2 kept from running away next to the light.
      const auto e = static_cast<float>(facing / std::max(0.09, distance * distance) / n);
      for (std::size_t c = 0; c < 3; ++c) out[c] += light.intensity[c] * e;
    }
  }
  return out;
}

void MeshRenderer::render(const Camera& camera, const Pose& pose, std::uint64_t frame, FrameBuffer& out) const {
  const std::int32_t w = camera.width_px, h = camera.height_px;
  const std::size_t pixels = pixel_at(0, h, w);
  out.width_px = w;
  out.height_px = h;
  out.rgb.assign(pixels * 3, 0);
  out.depth_m.assign(pixels, 0);
  out.label.assign(pixels, kVoid);
  out.instance.assign(pixels, 0);
  const std::vector<std::int32_t>& piece_of = mesh_.piece_of.empty() ? mesh_.object_of : mesh_.piece_of;
  std::vector<Surface> center(pixels);
  std::vector<Color> light(pixels);
  parallel_for(h, [&](std::int64_t y) {
    for (std::int32_t x = 0; x < w; ++x) {
      const std::size_t i = pixel_at(x, y, w);
      const Vec3d d = camera.direction(x + 0.5, static_cast<double>(y) + 0.5);
      if (dot(d, d) < 0.5) continue;
      center[i] = surface(pose.t, pose.rotate(d));
      if (center[i].triangle < 0) continue;
      out.depth_m[i] = static_cast<float>(center[i].distance_m * d.z);
      out.label[i] = class_of_[static_cast<std::size_t>(center[i].triangle)];
      out.instance[i] = piece_of[static_cast<std::size_t>(center[i].triangle)] + 1;
      light[i] = irradiance(center[i], (x & 3) + 4 * static_cast<int>(y & 3), frame, i);
    }
  });
  const int n = std::max(1, settings_.supersample);
  const double pixel_angle = 1.0 / (camera.fx * n);
  parallel_for(h, [&](std::int64_t row) {
    const auto y = static_cast<std::int32_t>(row);
    for (std::int32_t x = 0; x < w; ++x) {
      const std::size_t i = pixel_at(x, y, w);
      Color sum{};
      for (int k = 0; k < n * n; ++k) {
        const Vec3d d = camera.direction(x + (k % n + 0.5) / n, y + (k / n + 0.5) / n);
        const Surface s = dot(d, d) < 0.5 ? Surface{} : n == 1 ? center[i] : surface(pose.t, pose.rotate(d));
        if (s.triangle < 0) {
          for (std::size_t c = 0; c < 3; ++c) sum[c] += settings_.background[c];
          continue;
        }
        // A 4 x 4 window holds each of the 16 sample sets once; pixels of another surface are left out.
        Color e{};
        int used = 0;
        const double slack = 0.004 + 0.01 * s.distance_m;
        for (int dy = -2; dy < 2; ++dy) {
          for (int dx = -2; dx < 2; ++dx) {
            const std::int32_t px = x + dx + (k % n >= (n + 1) / 2 ? 1 : 0),
                               py = y + dy + (k / n >= (n + 1) / 2 ? 1 : 0);
            if (px < 0 || py < 0 || px >= w || py >= h) continue;
            const std::size_t q = pixel_at(px, py, w);
            const Surface& o = center[q];
            if (o.object != s.object || dot(o.normal, s.normal) < 0.94f) continue;
            if (std::abs(dot(o.point - s.point, to_double(s.facet))) > slack) continue;
            for (std::size_t c = 0; c < 3; ++c) e[c] += light[q][c];
            ++used;
          }
        }
        if (used == 0) {
          e = irradiance(s, (x & 3) + 4 * (y & 3), frame, pixels * static_cast<std::size_t>(k + 1) + i);
          used = 1;
        }
        const double cosine = std::max(0.15, std::abs(dot(to_double(s.facet), pose.rotate(d))));
        const Color a = albedo(s, s.distance_m * pixel_angle / std::sqrt(cosine));
        const Color glow = emission(s, a);
        for (std::size_t c = 0; c < 3; ++c) sum[c] += a[c] * e[c] / static_cast<float>(used) + glow[c];
      }
      for (std::size_t c = 0; c < 3; ++c) {
        // Film-like shoulder, so that bright walls keep their shading: 1 - exp(-exposure * L).
        const float tone = 1 - std::exp(-settings_.exposure * sum[c] / static_cast<float>(n * n));
        out.rgb[3 * i + c] = static_cast<std::uint8_t>(std::lround(255 * std::clamp(srgb_of_linear(tone), 0.0f, 1.0f)));
      }
    }
  });
}

// Texture lookup: pyramid by box filter, bilinear in each level, linear between levels.

// IEC 61966-2-1.
float srgb_of_linear(float value) {
  return value <= 0.0031308f ? value * 12.92f : 1.055f * std::pow(value, 1 / 2.4f) - 0.055f;
}

Texture::Texture(std::int32_t width, std::int32_t height, const std::vector<std::uint8_t>& rgb) {
  std::array<float, 256> table{};
  for (std::size_t i = 0; i < 256; ++i) {
    const float value = static_cast<float>(i) / 255.0f;
    table[i] = value <= 0.04045f ? value / 12.92f : std::pow((value + 0.055f) / 1.055f, 2.4f);
  }
  Level base{width, height, std::vector<float>(rgb.size())};
  for (std::size_t i = 0; i < rgb.size(); ++i) base.rgb[i] = table[rgb[i]];
  levels_.push_back(std::move(base));
  while (levels_.back().width > 1 || levels_.back().height > 1) {
    const Level& fine = levels_.back();
    Level coarse{std::max(1, fine.width / 2), std::max(1, fine.height / 2), {}};
    coarse.rgb.resize(static_cast<std::size_t>(coarse.width) * static_cast<std::size_t>(coarse.height) * 3);
    for (std::int32_t y = 0; y < coarse.height; ++y) {
      for (std::int32_t x = 0; x < coarse.width; ++x) {
        for (std::int32_t c = 0; c < 3; ++c) {
          float sum = 0;
          for (std::int32_t k = 0; k < 4; ++k) {
            const std::int32_t sx = std::min(2 * x + (k & 1), fine.width - 1);
            const std::int32_t sy = std::min(2 * y + (k >> 1), fine.height - 1);
            sum += fine.rgb[static_cast<std::size_t>((sy * fine.width + sx) * 3 + c)];
          }
          coarse.rgb[static_cast<std::size_t>((y * coarse.width + x) * 3 + c)] = sum * 0.25f;
        }
      }
    }
    levels_.push_back(std::move(coarse));
  }
}

Texture Texture::load(const std::string& path) {
  const Image<std::uint8_t> image = read_rgb(path);
  return Texture(image.width_px, image.height_px, image.pixels);
}

std::array<float, 3> Texture::bilinear(const Level& level, float u, float v) const {
  const float x = (u - std::floor(u)) * static_cast<float>(level.width) - 0.5f;
  const float y = (1 - (v - std::floor(v))) * static_cast<float>(level.height) - 0.5f;
  const float fx = x - std::floor(x), fy = y - std::floor(y);
  const auto wrap = [](float a, std::int32_t n) {
    const std::int32_t i = static_cast<std::int32_t>(std::floor(a)) % n;
    return i < 0 ? i + n : i;
  };
  const std::int32_t x0 = wrap(x, level.width), x1 = (x0 + 1) % level.width;
  const std::int32_t y0 = wrap(y, level.height), y1 = (y0 + 1) % level.height;
  const auto at = [&](std::int32_t px, std::int32_t py) {
    return &level.rgb[static_cast<std::size_t>(py * level.width + px) * 3];
  };
  const float *a = at(x0, y0), *b = at(x1, y0), *c = at(x0, y1), *d = at(x1, y1);
  std::array<float, 3> out{};
  for (std::size_t k = 0; k < 3; ++k) {
    const float top = a[k] + (b[k] - a[k]) * fx, bottom = c[k] + (d[k] - c[k]) * fx;
    out[k] = top + (bottom - top) * fy;
  }
  return out;
}

std::array<float, 3> Texture::sample(float u, float v, float level) const {
  if (!std::isfinite(u) || !std::isfinite(v)) return {0.5f, 0.5f, 0.5f};
  const float top = static_cast<float>(levels_.size() - 1);
  const float clamped = level > 0 ? std::min(level, top) : 0.0f;
  const auto i = static_cast<std::size_t>(clamped);
  const float f = clamped - static_cast<float>(i);
  std::array<float, 3> a = bilinear(levels_[i], u, v);
  if (f > 0 && i + 1 < levels_.size()) {
    const std::array<float, 3> b = bilinear(levels_[i + 1], u, v);
    for (std::size_t k = 0; k < 3; ++k) a[k] += (b[k] - a[k]) * f;
  }
  return a;
}

Mask Mask::load(const std::string& path) {
  Mask mask;
  const std::int32_t channels = image_size(path).channels;
  const bool has_alpha = channels == 4 || channels == 2;
  const Image<std::uint8_t> image = read_rgb(path, has_alpha ? 0 : -1, &mask.values_);
  mask.width_ = image.width_px;
  mask.height_ = image.height_px;
  for (std::size_t i = 0; !has_alpha && i < mask.values_.size(); ++i)
    mask.values_[i] =
        static_cast<std::uint8_t>((image.pixels[3 * i] + image.pixels[3 * i + 1] + image.pixels[3 * i + 2]) / 3);
  return mask;
}

bool Mask::opaque(float u, float v) const {
  if (!std::isfinite(u) || !std::isfinite(v)) return true;
  const auto x = std::min(static_cast<std::int32_t>((u - std::floor(u)) * static_cast<float>(width_)), width_ - 1);
  const auto y =
      std::min(static_cast<std::int32_t>((1 - (v - std::floor(v))) * static_cast<float>(height_)), height_ - 1);
  return values_[static_cast<std::size_t>(y * width_ + x)] >= 128;
}

namespace {

// Size and time of the file that holds this code: another build may cast other pictures.
std::string program_stamp() {
  Dl_info info{};
  if (dladdr(reinterpret_cast<const void*>(&program_stamp), &info) == 0 || info.dli_fname == nullptr) return {};
  std::error_code failed;
  const auto time = fs::last_write_time(info.dli_fname, failed).time_since_epoch().count();
  return fmt::format("{} {}\n", fs::file_size(info.dli_fname, failed), time);
}

}  // namespace

std::string cast_key(const std::string& settings, const std::vector<std::string>& files) {
  std::string text = program_stamp() + settings;
  for (const std::string& file : files) {
    try {
      text += sha256_of(read_text_file(file, std::size_t{1} << 30)) + "\n";
    } catch (const Error&) {
      text += "unreadable\n";  // a texture, which is a warning of the renderer and paints nothing
    }
  }
  return sha256_of(text);
}

CastCache::CastCache(const std::string& key) {
  const std::uint64_t limit = cache_limit();
  const std::string rooms = cache_folder("rooms");
  if (rooms.empty() || limit == 0) return;
  const std::string folder = (fs::path(rooms) / key).string();
  std::error_code failed;
  fs::create_directory(folder, failed);
  if (failed) return;
  use_cache_entry(folder, limit);
  folder_ = folder;
}

bool CastCache::read(std::uint64_t number, const FrameInfo& frame, FrameBuffer& out) const {
  if (folder_.empty()) return false;
  try {
    if (!fs::exists(file_of(number))) return false;
    PackedScene(file_of(number)).read(0, out);
    return out.width_px == frame.camera.width_px && out.height_px == frame.camera.height_px && !out.rgb.empty();
  } catch (const Error&) {
    return false;
  }
}

void CastCache::write(std::uint64_t number, const FrameInfo& frame, const ClassTable& classes,
                      const FrameBuffer& cast) const {
  if (folder_.empty()) return;
  try {
    write_packed_scene(
        file_of(number), {.name = "cast", .frames = {frame}, .classes = classes, .bounds = {}},
        [&cast](int, FrameBuffer& out) { out = cast; }, false);
  } catch (const Error&) {  // a full disk, or the folder was removed meanwhile
  }
}

}  // namespace semfield
