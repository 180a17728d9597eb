// What encoders of single rows share: a base for those that learn nothing, and the errors of rows and widths.
#pragma once

#include <string>
#include <utility>

#include "core/error.h"
#include "core/view.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"

namespace semfield {

/// Nearest point of [0, 1]; NaN becomes 0, so that no address made from it leaves a table.
SEMFIELD_HD inline double clamp_unit(double x) {
  const double above = x > 0 ? x : 0;
  return above < 1 ? above : 1;
}

/// Kernels of an encoder without tensors. Shape: what they know of its parameters, private to the plugin. x and dx [M,
/// in_dims], y and dy [M, out_dims].
template <class Real, class Shape>
struct RowKernels {
  /// Returns the first row that cannot be encoded, or -1. Runs in the calling thread.
  std::int64_t (*forward)(const Shape& shape, View<const double> x, View<Real> y) = nullptr;
  /// dx = dL/dx; may be parallel over blocks of rows.
  void (*backward)(const Shape& shape, View<const double> x, View<const Real> dy, View<Real> dx) = nullptr;
};

/// "encoder 'waves': coordinates of row 7 are not finite".
inline Error coordinates_not_finite(const std::string& owner, std::int64_t row) {
  return {ErrorKind::data, "scene.coordinates.not_finite",
          owner + ": coordinates of row " + std::to_string(row) + " are not finite",
          "check the camera poses and the ray limits"};
}

/// Throws Error(config): "encoder 'waves' takes 3 coordinates, got 2".
inline void require_in_dims(const std::string& owner, const EncoderBuild& build, std::int32_t wanted) {
  if (build.in_dims == wanted) return;
  throw Error(ErrorKind::config, "config.encoder.inputs",
              owner + " takes " + std::to_string(wanted) + " coordinates, got " + std::to_string(build.in_dims));
}

/// An encoder derives from it and gives it traits and shape.
template <class Real, class Shape>
class RowEncoder : public Encoder<Real> {
 public:
  EncoderTraits traits() const noexcept final { return traits_; }

 protected:
  /// owner: "encoder 'waves'", as in messages. Throws Error(unavailable) where the device has no kernels, Error(config)
  /// for other coordinates than those of the traits.
  RowEncoder(const EncoderBuild& build, const KernelTables& kernels, std::string owner, const EncoderTraits& traits,
             const Shape& shape)
      : kernels_(&kernels.get<RowKernels<Real, Shape>>(build.device, owner)),
        owner_(std::move(owner)),
        traits_(traits),
        shape_(shape) {
    require_in_dims(owner_, build, traits.in_dims);
  }
  /// What is wrong with a row of x that kernels refuse.
  virtual Error refused(View<const double>, std::int64_t row) const { return coordinates_not_finite(owner_, row); }

  void do_forward(const StepContext&, const Tensors<Real>&, View<const double> x, View<Real> y) const final {
    if (const std::int64_t bad = kernels_->forward(shape_, x, y); bad >= 0) throw refused(x, bad);
  }
  void do_backward(const StepContext&, const Tensors<Real>&, View<const double> x, View<const Real> dy,
                   View<Real> dx) const final {
    if (!dx.empty()) kernels_->backward(shape_, x, dy, dx);
  }

 private:
  const RowKernels<Real, Shape>* kernels_;
  std::string owner_;
  EncoderTraits traits_;
  Shape shape_;
};

}  // namespace semfield
