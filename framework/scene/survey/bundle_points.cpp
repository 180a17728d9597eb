// Points of a bundle where its cameras see them.
#include <Eigen/Cholesky>
#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>

#include "scene/bundle.h"

namespace semfield {

namespace {

constexpr double kLeastAngle = 0.01;  // radians between two rays that say where a point is

Eigen::Vector3d to_eigen(Vec3d v) { return {v.x, v.y, v.z}; }

double middle_of(std::vector<double> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + std::ssize(values) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

}  // namespace

void Bundle::measure() {
  std::vector<double> distances;
  for (const Track& track : tracks)
    for (const Sighting& s : track.seen)
      distances.push_back(length(track.point - poses[static_cast<std::size_t>(s.frame)].t));
  if (!distances.empty()) middle = middle_of(std::move(distances));
}

double error_px(const Bundle& bundle, const Track& track, const Sighting& sighting) {
  const auto f = static_cast<std::size_t>(sighting.frame);
  const Camera camera = bundle.camera(f);
  const Vec3d p = bundle.poses[f].apply_inverse(track.point);
  if (!camera.sees(p)) return std::numeric_limits<double>::infinity();
  double u = 0, v = 0;
  camera.project(p, u, v);
  return std::hypot(u - sighting.u, v - sighting.v);
}

double median_error_px(const Bundle& bundle) {
  std::vector<double> errors;
  for (const Track& track : bundle.tracks)
    for (const Sighting& s : track.seen) errors.push_back(error_px(bundle, track, s));
  return middle_of(std::move(errors));
}

bool settle_point(const Bundle& bundle, Track& track) {
  // Where all rays come nearest, then Gauss-Newton on the angles between rays and the point.
  Eigen::Matrix3d a = Eigen::Matrix3d::Zero();
  Eigen::Vector3d g = Eigen::Vector3d::Zero();
  std::vector<Eigen::Vector3d> rays, centers;
  double widest = 0;
  for (const Sighting& s : track.seen) {
    const auto f = static_cast<std::size_t>(s.frame);
    const Vec3d ray = bundle.camera(f).direction(s.u, s.v);
    if (dot(ray, ray) == 0) return false;
    rays.push_back(to_eigen(bundle.poses[f].rotate(ray)));
    centers.push_back(to_eigen(bundle.poses[f].t));
    for (const Eigen::Vector3d& other : rays) widest = std::max(widest, rays.back().cross(other).norm());
  }
  if (widest < kLeastAngle) return false;
  for (int pass = 0; pass < 8; ++pass) {
    Eigen::Vector3d x = to_eigen(track.point);
    a.setZero();
    g.setZero();
    for (std::size_t i = 0; i < rays.size(); ++i) {
      const Eigen::Matrix3d across = Eigen::Matrix3d::Identity() - rays[i] * rays[i].transpose();
      const double reach = pass == 0 ? 1 : std::max(1e-9 * bundle.middle, (x - centers[i]).norm());
      const double off = pass == 0 ? 0 : (across * (x - centers[i])).norm() / reach;
      const double weight = 1 / (reach * reach * (1 + off * off / 1e-4));
      a += weight * across;
      g += weight * across * centers[i];
    }
    x = a.ldlt().solve(g);
    if (!x.allFinite()) return false;
    track.point = Vec3d{x.x(), x.y(), x.z()};
  }
  return std::all_of(track.seen.begin(), track.seen.end(),
                     [&](const Sighting& s) { return std::isfinite(error_px(bundle, track, s)); });
}

}  // namespace semfield
