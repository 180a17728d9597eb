#include "model/camera_corrections.h"

namespace semfield {

namespace {

template <class Real>
void centre(View<const Real> from, double share, View<Real> to, bool add) {
  for (std::int32_t c = 0; c < from.cols; ++c) {
    double sum = 0;
    for (std::int64_t r = 0; r < from.rows; ++r) sum += static_cast<double>(from(r, c));
    const double mean = share * (sum / static_cast<double>(from.rows));
    for (std::int64_t r = 0; r < from.rows; ++r) {
      const auto centred = static_cast<Real>(static_cast<double>(from(r, c)) - mean);
      to(r, c) = add ? to(r, c) + centred : centred;
    }
  }
}

template <class Real>
Vec3d rotation_of(const Real* pose) {
  return {static_cast<double>(pose[0]), static_cast<double>(pose[1]), static_cast<double>(pose[2])};
}

std::int64_t camera_of(View<const float> camera, std::int64_t ray) { return static_cast<std::int64_t>(camera(ray, 0)); }

template <class Real>
void move(View<const float> camera, View<const Real> pose, double distance_m, View<double> origin,
          View<double> direction) {
  for (std::int64_t r = 0; r < camera.rows; ++r) {
    const Real* const row = pose.row(camera_of(camera, r));
    const Vec3d moved = rotated(rotation_of(row), {direction(r, 0), direction(r, 1), direction(r, 2)});
    for (int i = 0; i < 3; ++i) {
      direction(r, i) = moved[i];
      origin(r, i) += distance_m * static_cast<double>(row[3 + i]);
    }
  }
}

template <class Real>
void move_backward(View<const float> camera, View<const Real> pose, double distance_m, View<const double> direction,
                   View<const Real> d_ray, View<Real> d_pose) {
  for (std::int64_t r = 0; r < camera.rows; ++r) {
    const std::int64_t of = camera_of(camera, r);
    const Vec3d moved{direction(r, 0), direction(r, 1), direction(r, 2)};
    const Vec3d d_moved{static_cast<double>(d_ray(r, 3)), static_cast<double>(d_ray(r, 4)),
                        static_cast<double>(d_ray(r, 5))};
    const Vec3d d_rotation = rotation_gradient(rotation_of(pose.row(of)), moved, d_moved);
    for (int i = 0; i < 3; ++i) {
      d_pose(of, i) += static_cast<Real>(d_rotation[i]);
      d_pose(of, 3 + i) += static_cast<Real>(distance_m * static_cast<double>(d_ray(r, i)));
    }
  }
}

template <class Real>
void show(View<const float> camera, View<const Real> map, View<const Real> color, View<Real> shown) {
  for (std::int64_t r = 0; r < camera.rows; ++r) shown_color(map.row(camera_of(camera, r)), color.row(r), shown.row(r));
}

template <class Real>
void show_backward(View<const float> camera, View<const Real> map, View<const Real> color, View<const Real> d_shown,
                   View<Real> d_color, View<Real> d_map) {
  for (std::int64_t r = 0; r < camera.rows; ++r) {
    const std::int64_t of = camera_of(camera, r);
    shown_color_gradient(map.row(of), d_shown.row(r), d_color.row(r));
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) d_map(of, 4 * i + j) += d_shown(r, i) * color(r, j);
      d_map(of, 4 * i + 3) += d_shown(r, i);
    }
  }
}

}  // namespace

Pose corrected(const Pose& world_from_camera, const float* numbers, double distance_m) {
  Pose pose = world_from_camera;
  const Vec3d rotation{double{numbers[0]}, double{numbers[1]}, double{numbers[2]}};
  for (int column = 0; column < 3; ++column) {
    const Vec3d axis = rotated(rotation, pose.axis(column));
    for (int row = 0; row < 3; ++row)
      pose.r[static_cast<std::size_t>(row)][static_cast<std::size_t>(column)] = axis[row];
  }
  for (int i = 0; i < 3; ++i) pose.t[i] += distance_m * double{numbers[3 + i]};
  return pose;
}

template <class Real>
const CameraKernels<Real>& cpu_camera_kernels() {
  static const CameraKernels<Real> table{centre<Real>, move<Real>, move_backward<Real>, show<Real>,
                                         show_backward<Real>};
  return table;
}

template <class Real>
CameraCorrections<Real>::CameraCorrections(const CameraRules& rules, const Stages<Real>& stages,
                                           TensorStore<Real>& store)
    : rules_(rules),
      kernels_(stages.cameras),
      pose_table_(rules.count, kPoseNumbers, rules.alone ? 0 : 1, *kernels_),
      color_table_(rules.count, kColorNumbers, rules.alone ? 0 : 1, *kernels_),
      store_(&store) {
  if (rules_.poses) pose_ = store.add(kPoseName, pose_table_, {rules_.pose_rate, 0, false, !rules_.alone});
  if (rules_.colors) color_ = store.add(kColorName, color_table_, {rules_.color_rate, 0, false, !rules_.alone});
}

template const CameraKernels<float>& cpu_camera_kernels<float>();
template const CameraKernels<double>& cpu_camera_kernels<double>();
template class CameraCorrections<float>;
template class CameraCorrections<double>;

}  // namespace semfield
