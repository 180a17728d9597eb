// What a run learns of the cameras that it trains on: corrections of their poses and of their colours. The mean of
// either is the identity, so that neither the scene's frame nor its colours move; rendering of other views reads none.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/small_math.h"
#include "core/view.h"
#include "model/param_store.h"
#include "model/stages.h"
#include "plugin/sampler.h"

namespace semfield {

/// Numbers of a camera: a rotation vector in radians and a shift in units of a distance; a 3 x 4 map of colours, row by
/// row, as its difference from the identity.
inline constexpr int kPoseNumbers = 6, kColorNumbers = 12;

/// sin(a) / a, (1 - cos(a)) / a^2 and (a - sin(a)) / a^3 of a rotation vector of length a.
struct RotationTerms {
  double first, second, third;
};
SEMFIELD_HD inline RotationTerms rotation_terms(Vec3d w) {
  const double square = dot(w, w);
  if (square < 1e-6) {  // the next terms of the series are below 1e-13
    return {1 - square / 6, 0.5 - square / 24, 1.0 / 6 - square / 120};
  }
  const double angle = std::sqrt(square), sine = std::sin(angle), half = std::sin(0.5 * angle);
  return {sine / angle, 2 * half * half / square, (angle - sine) / (square * angle)};
}

/// exp([w]x) v [Sola18, App. B].
SEMFIELD_HD inline Vec3d rotated(Vec3d w, Vec3d v) {
  const RotationTerms terms = rotation_terms(w);
  const Vec3d once = cross(w, v);
  return v + once * terms.first + cross(w, once) * terms.second;
}

/// dL/dw of v' = exp([w]x) v from dL/dv': the transposed left Jacobian [Sola18, App. B] times v' x dL/dv'.
SEMFIELD_HD inline Vec3d rotation_gradient(Vec3d w, Vec3d moved, Vec3d d_moved) {
  const RotationTerms terms = rotation_terms(w);
  const Vec3d torque = cross(moved, d_moved), once = cross(w, torque);
  return torque - once * terms.second + cross(w, once) * terms.third;
}

/// A colour under the map of its camera.
template <class Real>
SEMFIELD_HD inline void shown_color(const Real* map, const Real* color, Real* shown) {
  for (int i = 0; i < 3; ++i) {
    const Real* const row = map + 4 * i;
    shown[i] = color[i] + (row[0] * color[0] + row[1] * color[1] + row[2] * color[2] + row[3]);
  }
}

/// dL/dcolor of shown_color.
template <class Real>
SEMFIELD_HD inline void shown_color_gradient(const Real* map, const Real* d_shown, Real* d_color) {
  for (int j = 0; j < 3; ++j)
    d_color[j] = d_shown[j] + (map[j] * d_shown[0] + map[4 + j] * d_shown[1] + map[8 + j] * d_shown[2]);
}

/// A pose under the numbers of its camera.
Pose corrected(const Pose& world_from_camera, const float* numbers, double distance_m);

struct CameraRules {
  std::int64_t count = 0;                ///< of training cameras; 0: none is corrected
  bool poses = false;                    ///< rotation about the camera's centre, and a shift of it
  bool colors = false;                   ///< an affine map of colours
  double distance_m = 1;                 ///< unit of shifts: what cameras look at lies about so far away
  double pose_rate = 0, color_rate = 0;  ///< factors to the learning rate
  double from_step = 0;                  ///< share of the run after which they move
  bool alone = false;  ///< nothing else learns, and means may move: cameras are fitted to a field that stays
  bool any() const { return count > 0 && (poses || colors); }
};

/// Stages of corrections. Cameras are numbered from 0; `camera` [R, 1] says whose a ray is. N cameras.
template <class Real>
struct CameraKernels {
  /// to [N, K] = from [N, K] less `share` of the mean of its column, or with `add` to += it, the gradient.
  void (*centre)(View<const Real> from, double share, View<Real> to, bool add) = nullptr;
  /// origin, direction [R, 3] under the pose [N, 6] of their cameras, whose shifts count by `distance_m`.
  void (*move)(View<const float> camera, View<const Real> pose, double distance_m, View<double> origin,
               View<double> direction) = nullptr;
  /// d_pose += gradients of R rays in their order, from d_ray [R, 6]: of the origin and of the direction, which has
  /// been moved.
  void (*move_backward)(View<const float> camera, View<const Real> pose, double distance_m,
                        View<const double> direction, View<const Real> d_ray, View<Real> d_pose) = nullptr;
  /// shown [R, 3] = colour [R, 3] under the map [N, 12] of its camera.
  void (*show)(View<const float> camera, View<const Real> map, View<const Real> color, View<Real> shown) = nullptr;
  /// d_color of it, and d_map += gradients of the rays in their order.
  void (*show_backward)(View<const float> camera, View<const Real> map, View<const Real> color,
                        View<const Real> d_shown, View<Real> d_color, View<Real> d_map) = nullptr;
};

/// Those of the CPU.
template <class Real>
const CameraKernels<Real>& cpu_camera_kernels();

/// A learned row per camera, and the same less the mean of all.
template <class Real>
class CentredTable final : public Parametric<Real> {
 public:
  CentredTable(std::int64_t rows, std::int32_t cols, double share, const CameraKernels<Real>& kernels)
      : rows_(rows), cols_(cols), share_(share), kernels_(&kernels) {}
  void declare(ParamDeclarer& declarer) const override {
    declarer.tensor({"learned", rows_, cols_, Init::constant(0), TensorRole::dense});
    declarer.tensor({"used", rows_, cols_, Init::constant(0), TensorRole::derived});
  }
  void derive(const StepContext&, const Tensors<Real>& tensors) const override {
    kernels_->centre(tensors.value[kLearned], share_, tensors.value[kUsed], false);
  }
  void derive_backward(const StepContext&, const Tensors<Real>& tensors) const override {
    kernels_->centre(tensors.grad[kUsed], share_, tensors.grad[kLearned], true);
  }
  static constexpr int kLearned = 0, kUsed = 1;

 private:
  std::int64_t rows_;
  std::int32_t cols_;
  double share_;  // of the mean that is taken away
  const CameraKernels<Real>* kernels_;
};

/// The corrections of a run, with tensors in a store.
template <class Real>
class CameraCorrections {
 public:
  CameraCorrections(const CameraRules& rules, const Stages<Real>& stages, TensorStore<Real>& store);

  const CameraRules& rules() const { return rules_; }
  void derive(const StepContext& ctx) const {
    if (rules_.poses) pose_table_.derive(ctx, store_->tensors(pose_));
    if (rules_.colors) color_table_.derive(ctx, store_->tensors(color_));
  }
  void derive_backward(const StepContext& ctx) const {
    if (rules_.poses) pose_table_.derive_backward(ctx, store_->tensors(pose_));
    if (rules_.colors) color_table_.derive_backward(ctx, store_->tensors(color_));
  }
  /// Moves rays where poses are corrected.
  void move(View<const float> camera, View<double> origin, View<double> direction) const {
    kernels_->move(camera, used(pose_), rules_.distance_m, origin, direction);
  }
  /// From d_ray [R, 6] into the lane's gradients.
  void move_backward(int lane, View<const float> camera, View<const double> direction, View<const Real> d_ray) const {
    kernels_->move_backward(camera, used(pose_), rules_.distance_m, direction, d_ray, gradient(pose_, lane));
  }
  /// Where colours are corrected.
  void show(View<const float> camera, View<const Real> color, View<Real> shown) const {
    kernels_->show(camera, used(color_), color, shown);
  }
  void show_backward(int lane, View<const float> camera, View<const Real> color, View<const Real> d_shown,
                     View<Real> d_color) const {
    kernels_->show_backward(camera, used(color_), color, d_shown, d_color, gradient(color_, lane));
  }

  static constexpr const char* kPoseName = "cameras/pose";
  static constexpr const char* kColorName = "cameras/color";

 private:
  View<Real> used(int component) const { return store_->tensors(component).value[CentredTable<Real>::kUsed]; }
  View<Real> gradient(int component, int lane) const {
    return store_->tensors(component, lane).grad[CentredTable<Real>::kUsed];
  }
  CameraRules rules_;
  const CameraKernels<Real>* kernels_;
  CentredTable<Real> pose_table_, color_table_;
  TensorStore<Real>* store_;
  int pose_ = -1, color_ = -1;
};

}  // namespace semfield
