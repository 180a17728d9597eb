#include "scene/survey/bundle.h"

#include <Eigen/Cholesky>
#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <tuple>

#include "formats/image_io.h"

namespace semfield {

namespace {

constexpr int kPoseSize = 6;
constexpr double kTurnMotion = 0.05, kShiftMotion = 0.05;  // of depth_from_color; the shift in Bundle::middle
constexpr int kLensSize = 8;
// One sigma of what a stated lens is off by.
constexpr double kLensSigma[kLensSize] = {0.3, 0.3, 0.03, 0.03, 0.3, 0.3, 0.01, 0.01};
constexpr double kAspect = 0.003;  // of fy over fx, beyond what was stated
constexpr double kFixed = 1e12;
constexpr double kTogether = 0.2;  // share of a pose's sigma by which neighbours that stand still differ

constexpr double kOffDepth = 0.15;  // relative distance beyond which a point is not of the surface shown
constexpr std::size_t kFewestOnDepth = 50;
constexpr double kDepthEdge = 0.04;  // relative step of depth between neighbours that is an edge

// The surface that a frame's depth shows where a point in the axes of its depth camera is seen.
struct Facet {
  Vec3d at, normal;
};

// Nothing at edges, without depth, and far from the surface.
std::optional<Facet> facet_at(const BundleDepth& view, Vec3d p) {
  const Camera& c = view.camera;
  if (view.depth_m.empty() || !c.sees(p) || !c.is_within_lens(p)) return {};
  double u = 0, v = 0;
  c.project(p, u, v);
  if (!(u >= 1 && v >= 1 && u < c.width_px - 1 && v < c.height_px - 1)) return {};
  const auto x = static_cast<std::int32_t>(u), y = static_cast<std::int32_t>(v);
  const auto at = [&](std::int32_t dx, std::int32_t dy) -> std::optional<Vec3d> {
    const auto depth = static_cast<double>(view.depth_m[pixel_at(x + dx, y + dy, c.width_px)]);
    const Vec3d ray = c.direction(x + dx + 0.5, y + dy + 0.5);
    if (!(depth > 0) || !(c.depth_of(ray) > 0)) return {};
    return ray * (depth / c.depth_of(ray));
  };
  const auto middle = at(0, 0), left = at(-1, 0), right = at(1, 0), up = at(0, -1), down = at(0, 1);
  if (!middle || !left || !right || !up || !down) return {};
  const double reach = length(*middle);
  for (const auto& side : {left, right, up, down}) {
    if (std::abs(length(*side) - reach) > kDepthEdge * reach) return {};
  }
  const Vec3d normal = cross(*right - *left, *down - *up);
  if (!(length(normal) > 0)) return {};
  Facet out{*middle, normalized(normal)};
  const double off = std::abs(dot(out.normal, p - out.at));
  return off < kOffDepth * reach ? std::optional<Facet>(out) : std::nullopt;
}

using Vec3e = Eigen::Vector3d;
using Mat3 = Eigen::Matrix3d;

Vec3e eigen(Vec3d v) { return {v.x, v.y, v.z}; }
Vec3d plain(const Vec3e& v) { return {v.x(), v.y(), v.z()}; }
Mat3 turn_of(const Pose& p) { return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(p.r[0].data()); }
Mat3 cross_matrix(const Vec3e& v) {
  Mat3 out;
  out << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return out;
}
Mat3 exponential(const Vec3e& w) {
  const double angle = w.norm();
  return angle < 1e-12 ? Mat3(Mat3::Identity() + cross_matrix(w))
                       : Eigen::AngleAxisd(angle, w / angle).toRotationMatrix();
}
Vec3e logarithm(const Mat3& r) {
  const Eigen::AngleAxisd turn(r);
  return turn.angle() * turn.axis();
}
Pose pose_of(const Mat3& r, const Vec3e& t) {
  Pose out;
  Eigen::Map<Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(out.r[0].data()) = r;
  out.t = plain(t);
  return out;
}

// By what the pose differs from the one given, as moved() takes it.
Eigen::Matrix<double, kPoseSize, 1> moved_by(const Pose& given, const Pose& now) {
  const Mat3 turn = turn_of(now).transpose() * turn_of(given);
  const Vec3e shift = turn_of(now).transpose() * eigen(given.t - now.t);
  Eigen::Matrix<double, kPoseSize, 1> out;
  out << logarithm(turn), shift;
  return out;
}

// A sighting's errors and their slopes, each in units of its sigma.
struct Rows {
  int count = 0;  // 2, or 3 with depth
  double weight[3] = {};
  Eigen::Vector3d error = Eigen::Vector3d::Zero();
  Eigen::Matrix<double, 3, kPoseSize> by_pose = Eigen::Matrix<double, 3, kPoseSize>::Zero();
  Eigen::Matrix<double, 3, kLensSize> by_lens = Eigen::Matrix<double, 3, kLensSize>::Zero();
  Eigen::Matrix<double, 3, kPoseSize> by_motion = Eigen::Matrix<double, 3, kPoseSize>::Zero();
  Mat3 by_point = Mat3::Zero();
  double cost = 0;
};

double cauchy(double squared) { return std::log1p(squared); }

class Adjustment {
 public:
  Adjustment(Bundle& bundle, const BundleOptions& options)
      : b_(bundle),
        o_(options),
        frames_(static_cast<int>(bundle.poses.size())),
        lens_at_(kPoseSize * frames_),
        motion_at_(lens_at_ + kLensSize * static_cast<int>(bundle.lenses.size())),
        size_(motion_at_ + kPoseSize) {}

  void run() {
    double damping = 1e-4, now = cost();
    for (int i = 0; i < o_.iterations && damping < 1e8; ++i) {
      build();
      bool better = false;
      for (; !better && damping < 1e8; damping *= 8) {
        // Only what a step moves; the tracks' sightings stay.
        const auto before = std::tuple(b_.poses, b_.lenses, b_.depth_from_color);
        std::vector<Vec3d> points;
        for (const Track& track : b_.tracks) points.push_back(track.point);
        if (!step(damping)) continue;
        const double then = cost();
        better = then < now;
        if (!better) {
          std::tie(b_.poses, b_.lenses, b_.depth_from_color) = before;
          for (std::size_t t = 0; t < points.size(); ++t) b_.tracks[t].point = points[t];
          continue;
        }
        const bool still = now - then < 1e-5 * now;
        now = then;
        damping = std::max(1e-9, damping / 80);
        if (still) return;
      }
    }
  }

 private:
  Rows rows(const Track& track, const Sighting& s, const std::vector<Camera>& cameras, bool slopes) const {
    Rows out;
    const auto f = static_cast<std::size_t>(s.frame);
    const Camera& camera = cameras[f];
    const Pose& pose = b_.poses[f];
    const Vec3d p = pose.apply_inverse(track.point);
    if (!camera.sees(p)) {
      out.cost = cauchy(1e6);
      return out;
    }
    double u = 0, v = 0;
    camera.project(p, u, v);
    const double sigma = o_.outlier_px;
    out.count = 2;
    out.error.head<2>() << (u - s.u) / sigma, (v - s.v) / sigma;
    const double squared = out.error.head<2>().squaredNorm();
    out.cost = cauchy(squared);
    out.weight[0] = out.weight[1] = 1 / (1 + squared);
    std::optional<Facet> facet;
    Vec3e in_depth = Vec3e::Zero();
    if (o_.use_depth) {
      const Vec3d q = b_.depth_from_color.apply(p);
      in_depth = eigen(q);
      facet = facet_at(b_.depth[f], q);
      // No surface says as little as one that is far off.
      const double none = kOffDepth / o_.depth_share / 3;
      double squared_depth = none * none;
      if (facet) {
        out.count = 3;
        const double distance_sigma = 3 * o_.depth_share * in_depth.norm();
        out.error.z() = eigen(facet->normal).dot(in_depth - eigen(facet->at)) / distance_sigma;
        squared_depth = std::min(squared_depth, out.error.z() * out.error.z());
        out.weight[2] = 1 / (1 + squared_depth);
      }
      out.cost += cauchy(squared_depth);
    }
    if (!slopes) return out;
    const Vec3e pe = eigen(p);
    Eigen::Matrix<double, 2, 3> by_p;
    // By how much two steps of `h` apart differ in the image.
    const auto slope = [&](const Camera& c1, Vec3d p1, const Camera& c0, Vec3d p0, double h) {
      double u1 = 0, v1 = 0, u0 = 0, v0 = 0;
      c1.project(p1, u1, v1);
      c0.project(p0, u0, v0);
      return Eigen::Vector2d((u1 - u0) / (2 * h * sigma), (v1 - v0) / (2 * h * sigma));
    };
    const double h = 1e-6 * std::max(1e-9, length(p));
    for (int a = 0; a < 3; ++a) {
      Vec3d up = p, down = p;
      up[a] += h;
      down[a] -= h;
      by_p.col(a) = slope(camera, up, camera, down, h);
    }
    Eigen::Matrix<double, 3, kPoseSize> p_by_pose;
    p_by_pose << -cross_matrix(pe), Mat3::Identity();
    const Mat3 p_by_point = turn_of(pose).transpose();
    out.by_pose.topRows<2>() = by_p * p_by_pose;
    out.by_point.topRows<2>() = by_p * p_by_point;
    if (o_.move_focal || o_.move_lens) {
      const LensChange& change = b_.lenses[static_cast<std::size_t>(b_.lens_of[f])];
      for (int k = 0; k < kLensSize; ++k) {
        const double step = 1e-6;
        LensChange more = change, less = change;
        more.by[static_cast<std::size_t>(k)] += step;
        less.by[static_cast<std::size_t>(k)] -= step;
        out.by_lens.col(k).head<2>() = slope(more.applied_to(b_.stated[f]), p, less.applied_to(b_.stated[f]), p, step);
      }
    }
    if (facet) {
      const double distance_sigma = 3 * o_.depth_share * in_depth.norm();
      const Eigen::RowVector3d n = eigen(facet->normal).transpose() / distance_sigma;
      const Eigen::RowVector3d n_in_color = n * turn_of(b_.depth_from_color);
      out.by_pose.row(2) = n_in_color * p_by_pose;
      out.by_point.row(2) = n_in_color * p_by_point;
      out.by_motion.row(2) << n * -cross_matrix(in_depth), n;
    }
    return out;
  }

  std::vector<Camera> cameras() const {
    std::vector<Camera> out;
    for (std::size_t f = 0; f < b_.poses.size(); ++f) out.push_back(b_.camera(f));
    return out;
  }

  double sigma_of(int k) const { return k < 3 ? o_.turn_rad : o_.shift * b_.middle; }

  // How much further than themselves the corrections of two frames in a row may differ, as a factor of their sigma.
  double apart(std::size_t f) const {
    const Pose &a = b_.given[f], &c = b_.given[f + 1];
    const double turn = logarithm(turn_of(a).transpose() * turn_of(c)).norm(), shift = length(a.t - c.t);
    return std::min(1.0, kTogether + shift / (0.2 * b_.middle) + turn / 0.2);
  }

  // Calls `row(error, weight, first variable, second variable or -1, slopes)` of everything known before.
  template <class Row>
  double priors(const Row& row) const {
    double sum = 0;
    const auto add = [&](double error, bool robust, int i, double slope, int j, double other) {
      const double squared = robust ? error * error / 9 : error * error;
      sum += robust ? 9 * cauchy(squared) : squared;
      row(error, robust ? 1 / (1 + squared) : 1.0, i, slope, j, other);
    };
    std::vector<Eigen::Matrix<double, kPoseSize, 1>> moves;
    for (std::size_t f = 0; f < b_.poses.size(); ++f) {
      moves.push_back(moved_by(b_.given[f], b_.poses[f]));
      for (int k = 0; k < kPoseSize; ++k)
        add(moves[f][k] / sigma_of(k), true, kPoseSize * static_cast<int>(f) + k, 1 / sigma_of(k), -1, 0);
    }
    for (std::size_t f = 0; f + 1 < moves.size(); ++f) {
      const double factor = apart(f);
      for (int k = 0; k < kPoseSize; ++k) {
        const double sigma = sigma_of(k) * factor;
        add((moves[f][k] - moves[f + 1][k]) / sigma, true, kPoseSize * static_cast<int>(f) + k, 1 / sigma,
            kPoseSize * static_cast<int>(f + 1) + k, -1 / sigma);
      }
    }
    for (std::size_t g = 0; g < b_.lenses.size(); ++g) {
      const auto& by = b_.lenses[g].by;
      const int at = lens_at_ + kLensSize * static_cast<int>(g);
      for (int k = 0; k < kLensSize; ++k)
        add(by[static_cast<std::size_t>(k)] / kLensSigma[k], false, at + k, 1 / kLensSigma[k], -1, 0);
      add((by[1] - by[0]) / kAspect, false, at + 1, 1 / kAspect, at, -1 / kAspect);
    }
    const Vec3e turn = logarithm(turn_of(b_.depth_from_color));
    for (int k = 0; k < kPoseSize; ++k) {
      const double sigma = k < 3 ? kTurnMotion : kShiftMotion * b_.middle;
      const double value = k < 3 ? turn[k] : b_.depth_from_color.t[k - 3];
      add(value / sigma, false, motion_at_ + k, 1 / sigma, -1, 0);
    }
    return sum;
  }

  double cost() const {
    const std::vector<Camera> now = cameras();
    double sum = priors([](double, double, int, double, int, double) {});
    for (const Track& track : b_.tracks) {
      for (const Sighting& s : track.seen) sum += rows(track, s, now, false).cost * kSightings;
    }
    return sum;
  }

  bool fixed(int variable) const {
    if (variable < lens_at_) return !o_.move_poses;
    if (variable >= motion_at_) return !o_.move_depth_camera;
    const int k = (variable - lens_at_) % kLensSize;
    return k < 2 ? !o_.move_focal : !o_.move_lens;
  }

  void build() {
    const std::vector<Camera> now = cameras();
    h_ = Eigen::MatrixXd::Zero(size_, size_);
    g_ = Eigen::VectorXd::Zero(size_);
    points_of_.assign(b_.tracks.size(), {});
    (void)priors([&](double error, double weight, int i, double slope, int j, double other) {
      h_(i, i) += weight * slope * slope;
      g_[i] += weight * slope * error;
      if (j < 0) return;
      h_(j, j) += weight * other * other;
      g_[j] += weight * other * error;
      h_(i, j) += weight * slope * other;
      h_(j, i) += weight * slope * other;
    });
    for (std::size_t t = 0; t < b_.tracks.size(); ++t) {
      const Track& track = b_.tracks[t];
      PointPart& part = points_of_[t];
      for (const Sighting& s : track.seen) add_sighting(rows(track, s, now, true), s.frame, part);
    }
  }

  struct Block {
    int at = 0;
    Eigen::Matrix<double, kLensSize, 3> w = Eigen::Matrix<double, kLensSize, 3>::Zero();  // rows beyond `size` are 0
    int size = 0;
  };
  struct PointPart {
    Mat3 v = Mat3::Zero();
    Vec3e g = Vec3e::Zero();
    std::vector<Block> blocks;
  };

  static Block& block(PointPart& part, int at, int size) {
    for (Block& one : part.blocks)
      if (one.at == at) return one;
    return part.blocks.emplace_back(Block{.at = at, .size = size});
  }

  void add_sighting(const Rows& r, std::int32_t frame, PointPart& part) {
    if (r.count == 0) return;
    Eigen::DiagonalMatrix<double, 3> w(kSightings * r.weight[0], kSightings * r.weight[1], kSightings * r.weight[2]);
    const int pose_at = kPoseSize * frame, lens_at = lens_at_ + kLensSize * b_.lens_of[static_cast<std::size_t>(frame)];
    const auto pose_w = (r.by_pose.transpose() * w).eval();
    const auto lens_w = (r.by_lens.transpose() * w).eval();
    h_.block<kPoseSize, kPoseSize>(pose_at, pose_at) += pose_w * r.by_pose;
    h_.block<kPoseSize, kLensSize>(pose_at, lens_at) += pose_w * r.by_lens;
    h_.block<kLensSize, kPoseSize>(lens_at, pose_at) += lens_w * r.by_pose;
    h_.block<kLensSize, kLensSize>(lens_at, lens_at) += lens_w * r.by_lens;
    g_.segment<kPoseSize>(pose_at) += pose_w * r.error;
    g_.segment<kLensSize>(lens_at) += lens_w * r.error;
    const auto point_w = (r.by_point.transpose() * w).eval();
    part.v += point_w * r.by_point;
    part.g += point_w * r.error;
    block(part, pose_at, kPoseSize).w.topRows<kPoseSize>() += pose_w * r.by_point;
    block(part, lens_at, kLensSize).w += lens_w * r.by_point;
    if (r.count < 3) return;
    const auto motion_w = (r.by_motion.transpose() * w).eval();
    const auto cross_pose = (motion_w * r.by_pose).eval();
    h_.block<kPoseSize, kPoseSize>(motion_at_, motion_at_) += motion_w * r.by_motion;
    h_.block<kPoseSize, kPoseSize>(motion_at_, pose_at) += cross_pose;
    h_.block<kPoseSize, kPoseSize>(pose_at, motion_at_) += cross_pose.transpose();
    g_.segment<kPoseSize>(motion_at_) += motion_w * r.error;
    block(part, motion_at_, kPoseSize).w.topRows<kPoseSize>() += motion_w * r.by_point;
  }

  bool step(double damping) {
    Eigen::MatrixXd h = h_;
    Eigen::VectorXd g = g_;
    std::vector<Mat3> inverses(points_of_.size());
    for (std::size_t t = 0; t < points_of_.size(); ++t) {
      const PointPart& part = points_of_[t];
      Mat3 v = part.v;
      v.diagonal() *= 1 + damping;
      v.diagonal().array() += 1e-12 / (b_.middle * b_.middle);
      inverses[t] = v.inverse();
      for (const Block& a : part.blocks) {
        const Eigen::Matrix<double, kLensSize, 3> wa = a.w * inverses[t];
        g.segment(a.at, a.size) -= (wa * part.g).head(a.size);
        for (const Block& c : part.blocks)
          h.block(a.at, c.at, a.size, c.size) -= (wa * c.w.transpose()).topLeftCorner(a.size, c.size);
      }
    }
    for (int i = 0; i < size_; ++i) h(i, i) += fixed(i) ? kFixed * (1 + h_(i, i)) : damping * h_(i, i);
    const Eigen::LLT<Eigen::MatrixXd> solver(h);
    if (solver.info() != Eigen::Success) return false;
    const Eigen::VectorXd x = -solver.solve(g);
    if (!x.allFinite()) return false;
    for (std::size_t f = 0; f < b_.poses.size(); ++f) {
      std::array<double, 6> by{};
      for (int k = 0; k < kPoseSize; ++k) by[static_cast<std::size_t>(k)] = x[kPoseSize * static_cast<int>(f) + k];
      b_.poses[f] = moved(b_.poses[f], by);
    }
    for (std::size_t l = 0; l < b_.lenses.size(); ++l)
      for (int k = 0; k < kLensSize; ++k)
        b_.lenses[l].by[static_cast<std::size_t>(k)] += x[lens_at_ + kLensSize * static_cast<int>(l) + k];
    const Vec3e turn = x.segment<3>(motion_at_), shift = x.segment<3>(motion_at_ + 3);
    const Mat3 turned = exponential(turn);
    b_.depth_from_color = pose_of(turned * turn_of(b_.depth_from_color), turned * eigen(b_.depth_from_color.t) + shift);
    for (std::size_t t = 0; t < points_of_.size(); ++t) {
      Vec3e right = -points_of_[t].g;
      for (const Block& a : points_of_[t].blocks) right -= a.w.transpose().leftCols(a.size) * x.segment(a.at, a.size);
      b_.tracks[t].point = b_.tracks[t].point + plain(inverses[t] * right);
    }
    return true;
  }

  // A sighting's weight beside priors, whose errors are in sigmas: Cauchy's scale is four times the noise of features.
  static constexpr double kSightings = 4;
  Bundle& b_;
  const BundleOptions& o_;
  int frames_, lens_at_, motion_at_, size_;
  Eigen::MatrixXd h_;
  Eigen::VectorXd g_;
  std::vector<PointPart> points_of_;
};

}  // namespace

Camera LensChange::applied_to(const Camera& stated) const {
  Camera out = stated;
  out.fx *= std::exp(by[0]);
  out.fy *= std::exp(by[1]);
  out.cx += by[2] * stated.width_px;
  out.cy += by[3] * stated.height_px;
  out.k1 += by[4];
  out.k2 += by[5];
  if (!stated.is_wide()) {
    out.p1 += by[6];
    out.p2 += by[7];
  }
  return out;
}

Pose moved(const Pose& world_from_camera, const std::array<double, 6>& by) {
  const Mat3 turn = exponential({by[0], by[1], by[2]});
  const Vec3e shift(by[3], by[4], by[5]);
  // camera_from_world' = turn * camera_from_world + shift.
  const Mat3 r = turn_of(world_from_camera);
  const Mat3 now = r * turn.transpose();
  Pose out = pose_of(now, eigen(world_from_camera.t) - now * shift);
  make_rotation(out);
  return out;
}

void adjust(Bundle& bundle, const BundleOptions& options) {
  if (bundle.tracks.empty()) return;
  Adjustment(bundle, options).run();
}

void align_depth(Bundle& bundle) {
  using Vec6 = Eigen::Matrix<double, kPoseSize, 1>;
  for (int pass = 0; pass < 20; ++pass) {
    Eigen::Matrix<double, kPoseSize, kPoseSize> h = Eigen::Matrix<double, kPoseSize, kPoseSize>::Zero();
    Vec6 g = Vec6::Zero();
    std::size_t found = 0;
    for (const Track& track : bundle.tracks) {
      for (const Sighting& s : track.seen) {
        const auto f = static_cast<std::size_t>(s.frame);
        const Vec3d q = bundle.depth_from_color.apply(bundle.poses[f].apply_inverse(track.point));
        const std::optional<Facet> facet = facet_at(bundle.depth[f], q);
        if (!facet) continue;
        ++found;
        const double sigma = 0.02 * length(q);
        const Vec3e n = eigen(facet->normal) / sigma;
        const double error = n.dot(eigen(q - facet->at)), weight = 1 / (1 + error * error);
        Vec6 slope;
        slope << eigen(q).cross(n), n;
        h += weight * slope * slope.transpose();
        g += weight * slope * error;
      }
    }
    if (found < kFewestOnDepth) return;
    for (int k = 0; k < kPoseSize; ++k)
      h(k, k) += std::pow(k < 3 ? 1 / kTurnMotion : 1 / (kShiftMotion * bundle.middle), 2);
    const Vec6 x = -h.ldlt().solve(g);
    if (!x.allFinite()) return;
    const Mat3 turned = exponential(x.head<3>());
    bundle.depth_from_color =
        pose_of(turned * turn_of(bundle.depth_from_color), turned * eigen(bundle.depth_from_color.t) + x.tail<3>());
    if (x.norm() < 1e-7) break;
  }
}

// Points of a bundle against the depth that frames show.

double share_on_depth(const Bundle& bundle) {
  std::size_t all = 0, on = 0;
  for (const Track& track : bundle.tracks) {
    for (const Sighting& s : track.seen) {
      const auto f = static_cast<std::size_t>(s.frame);
      if (f >= bundle.depth.size()) continue;
      const Vec3d p = bundle.depth_from_color.apply(bundle.poses[f].apply_inverse(track.point));
      const std::optional<Facet> facet = facet_at(bundle.depth[f], p);
      if (!facet) continue;
      ++all;
      on += std::abs(dot(facet->normal, p - facet->at)) < 0.02 * length(p) ? 1 : 0;
    }
  }
  return all < kFewestOnDepth ? -1 : static_cast<double>(on) / static_cast<double>(all);
}

// Points of a bundle where its cameras see them.

namespace {

constexpr double kLeastAngle = 0.01;  // radians between two rays that say where a point is

}  // namespace

void Bundle::measure() {
  std::vector<double> distances;
  for (const Track& track : tracks)
    for (const Sighting& s : track.seen)
      distances.push_back(length(track.point - poses[static_cast<std::size_t>(s.frame)].t));
  if (!distances.empty()) middle = median_of(std::move(distances));
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
    rays.push_back(eigen(bundle.poses[f].rotate(ray)));
    centers.push_back(eigen(bundle.poses[f].t));
    for (const Eigen::Vector3d& other : rays) widest = std::max(widest, rays.back().cross(other).norm());
  }
  if (widest < kLeastAngle) return false;
  for (int pass = 0; pass < 8; ++pass) {
    Eigen::Vector3d x = eigen(track.point);
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
