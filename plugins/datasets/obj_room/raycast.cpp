// Embree scene (version 3 or 4): one geometry for opaque triangles, one with a filter for cut-outs.
#include "datasets/obj_room/raycast.h"

#include <algorithm>
#include <cmath>
#include <limits>

#ifdef SEMFIELD_WITH_RAYCAST
#if SEMFIELD_EMBREE == 3
#include <embree3/rtcore.h>
#else
#include <embree4/rtcore.h>
#endif
#endif

namespace semfield {

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
    for (std::size_t i = 0; i < mesh.positions.size(); ++i) {
      for (int k = 0; k < 3; ++k) vertices[3 * i + static_cast<std::size_t>(k)] = mesh.positions[i][k];
    }
    for (std::size_t i = 0; i < list.size(); ++i) {
      for (std::size_t k = 0; k < 3; ++k) indices[3 * i + k] = mesh.triangles[static_cast<std::size_t>(list[i])][k];
    }
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
  if (impl_->device == nullptr) {
    throw Error(ErrorKind::unavailable, "system.embree.failed",
                "Embree cannot start (error " + std::to_string(rtcGetDeviceError(nullptr)) + ")");
  }
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
  if (rtcGetDeviceError(impl_->device) != RTC_ERROR_NONE) {
    throw Error(ErrorKind::unavailable, "memory.raycast.full", "Embree cannot build the ray-casting scene",
                "use a smaller mesh");
  }
}

namespace {

// Embree 4 has no contexts any more.
#if SEMFIELD_EMBREE == 3
void intersect(RTCScene scene, RTCRayHit& ray) {
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcIntersect1(scene, &context, &ray);
}
void occlude(RTCScene scene, RTCRay& ray) {
  RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  rtcOccluded1(scene, &context, &ray);
}
#else
void intersect(RTCScene scene, RTCRayHit& ray) { rtcIntersect1(scene, &ray); }
void occlude(RTCScene scene, RTCRay& ray) { rtcOccluded1(scene, &ray); }
#endif

}  // namespace

RayHit Raycaster::trace(Vec3d origin, Vec3d direction, double max_m) const {
  RTCRayHit ray{};
  ray.ray.org_x = static_cast<float>(origin.x);
  ray.ray.org_y = static_cast<float>(origin.y);
  ray.ray.org_z = static_cast<float>(origin.z);
  ray.ray.dir_x = static_cast<float>(direction.x);
  ray.ray.dir_y = static_cast<float>(direction.y);
  ray.ray.dir_z = static_cast<float>(direction.z);
  ray.ray.tfar = static_cast<float>(max_m);
  ray.ray.mask = ~0u;
  ray.hit.geomID = RTC_INVALID_GEOMETRY_ID;
  intersect(impl_->scene, ray);
  RayHit hit;
  if (ray.hit.geomID == RTC_INVALID_GEOMETRY_ID) return hit;
  hit.triangle = impl_->triangle_of[ray.hit.geomID][ray.hit.primID];
  hit.b1 = ray.hit.u;
  hit.b2 = ray.hit.v;
  // Float32 tells which triangle; its plane in float64 tells how far.
  const auto& corners = impl_->mesh.triangles[static_cast<std::size_t>(hit.triangle)];
  const auto corner = [&](std::size_t k) {
    const Vec3f p = impl_->mesh.positions[corners[k]];
    return Vec3d{p.x, p.y, p.z};
  };
  const Vec3d a = corner(0);
  const Vec3d normal = cross(corner(1) - a, corner(2) - a);
  const double along = dot(normal, direction);
  const double exact = along != 0 ? dot(normal, a - origin) / along : ray.ray.tfar;
  // Grazing rays have no stable plane distance.
  hit.distance_m = std::abs(exact - ray.ray.tfar) < 1e-3 * (1 + std::abs(exact)) ? exact : ray.ray.tfar;
  return hit;
}

bool Raycaster::blocked(Vec3d origin, Vec3d direction, double max_m) const {
  RTCRay ray{};
  ray.org_x = static_cast<float>(origin.x);
  ray.org_y = static_cast<float>(origin.y);
  ray.org_z = static_cast<float>(origin.z);
  ray.dir_x = static_cast<float>(direction.x);
  ray.dir_y = static_cast<float>(direction.y);
  ray.dir_z = static_cast<float>(direction.z);
  ray.tfar = static_cast<float>(max_m);
  ray.mask = ~0u;
  occlude(impl_->scene, ray);
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
  const std::int64_t triangle = nearest.triangle_of[args->geomID][args->primID];
  const auto& index = nearest.mesh->triangles[static_cast<std::size_t>(triangle)];
  const auto corner = [&](std::size_t k) {
    const Vec3f p = nearest.mesh->positions[index[k]];
    return Vec3d{p.x, p.y, p.z};
  };
  const Vec3d on = nearest_on_triangle(nearest.point, corner(0), corner(1), corner(2));
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

}  // namespace semfield
