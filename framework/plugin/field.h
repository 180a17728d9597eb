// Field: encoded position (and, for colour alone, encoded direction) to density, colour and a position-only feature.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/half.h"
#include "core/view.h"
#include "plugin/parametric.h"

namespace semfield {

/// How a field hands its feature on. Every field can write it in full, FieldOut::feature; the other forms save the
/// bytes between field and head.
enum class FeatureForm : std::uint8_t {
  full,          ///< FieldOut::feature alone
  rounded,       ///< also FusedOut::feature
  hidden_layer,  ///< also FusedOut::hidden: the field computes the head's hidden layer where its feature lies
};

/// The hidden layer of the semantic head, relu(feature W + b).
template <class Real>
struct HiddenLayer {
  View<const Real> weight, bias;  ///< [F, H], [1, H]
  View<Real> d_weight, d_bias;    ///< backward adds to them
};

/// Of M samples; empty: not wanted. At most one of FieldOut::feature and these two is given.
template <class Real>
struct FusedOut {
  View<Bf16> feature;       ///< [M, F]
  View<Bf16> hidden;        ///< [N <= M, H], `layer` of the first N features; wanted together with the colour
  HiddenLayer<Real> layer;  ///< of `hidden`
};

/// dL/d(FusedOut), in the form in which forward gave it.
struct FusedGrad {
  View<const Bf16> feature;  ///< [N <= M, F]; zero for the rows behind
  /// dL/d(hidden) before the ReLU: blocked_rows(N) x H numbers in 8 x 8 blocks of 128 contiguous bytes, blocks of 8
  /// rows one behind the other; zero in the rows behind N. FusedOut::layer has room for the layer's own gradients.
  const Bf16* hidden = nullptr;
};
/// Rows of FusedGrad::hidden: whole tiles of the fields that take it.
constexpr std::int64_t blocked_rows(std::int64_t rows) { return (rows + 255) / 256 * 256; }

struct FieldTraits {
  std::int32_t feature_dims = 0;  ///< width of the feature the semantic head reads
  bool uses_direction = false;
};

/// M samples of R rays. direction is encoded once per ray.
template <class Real>
struct FieldIn {
  View<const Real> position{};               ///< [M, Dp]
  View<const Real> direction{};              ///< [R, Dd]; empty when the view branch is left out
  View<const std::int32_t> ray_of_sample{};  ///< [M, 1], 0..R-1, ascending
};

/// Empty view = not wanted (not computed). Overwritten.
template <class Real>
struct FieldOut {
  View<Real> sigma{};      ///< [M, 1] before activation, 1/m
  View<Real> rgb{};        ///< [M, 3] in (0, 1)
  View<Real> feature{};    ///< [M, F], a function of position only
  FusedOut<Real> fused{};  ///< only where feature_form() offers it
};

/// dL/d(outputs); empty view = zero.
template <class Real>
struct FieldGrad {
  View<const Real> sigma{}, rgb{}, feature{};
  FusedGrad fused{};
};

template <class Real>
class Field : public Parametric<Real> {
 public:
  virtual FieldTraits traits() const noexcept = 0;
  /// What it offers a head whose hidden layer has `hidden_width` numbers (plugin/field.h).
  virtual FeatureForm feature_form(std::int32_t hidden_width) const noexcept {
    (void)hidden_width;
    return FeatureForm::full;
  }
  /// Bytes that forward leaves for backward with M samples of R rays.
  virtual std::size_t saved_bytes(std::int64_t samples, std::int64_t rays) const noexcept = 0;
  /// "runs layer by layer here; ...", and what the fast way needs, where it computes more slowly than it could: a run
  /// on a GPU asks its fields and warns.
  virtual std::string slow_path() const { return {}; }

  /// saved may be empty when no backward will follow.
  void forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in, const FieldOut<Real>& out,
               Saved saved) const;
  /// tensors.grad += dL/dtheta; d_position = dL/d(position) [M, Dp] when not empty. `out` is what forward gave. Runs
  /// inside one thread of a tile; tensors.grad belongs to the lane.
  void backward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                const FieldOut<Real>& out, const FieldGrad<Real>& grad, Saved saved, View<Real> d_position) const;

 protected:
  virtual void do_forward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>&, const FieldOut<Real>&,
                          Saved) const = 0;
  virtual void do_backward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>&, const FieldOut<Real>&,
                           const FieldGrad<Real>&, Saved, View<Real> d_position) const = 0;
};

/// The exact savings (same function, same gradients), each with its off-switch for the parity test.
struct ExactSavings {
  bool fold_feature_layer = true;      ///< multiply feature and view layer once per step (no activation stands between)
  bool direction_once_per_ray = true;  ///< the view layer's direction part and bias once per ray
};

struct FieldBuild {
  Device device = Device::cpu;
  std::int32_t position_dims = 0;
  std::int32_t direction_dims = 0;  ///< 0: the view branch is left out
  bool feature_only = false;        ///< true: neither density nor colour is ever asked for, and may be left out
  ExactSavings savings{};
  Precision precision = Precision::fp32;  ///< of the matrix products; a field without such kernels refuses
};

extern template class Field<float>;
extern template class Field<double>;

}  // namespace semfield
