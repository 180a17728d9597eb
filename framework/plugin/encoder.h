// Encoder: coordinates to features, one batch a call.
#pragma once

#include "plugin/parametric.h"

namespace semfield {

enum class Domain : std::uint8_t {
  metric,     ///< any real coordinates: world position times scene_scale, about [-1, 1]
  unit_cube,  ///< [0, 1]^D; the implementation clamps
  direction,  ///< unit vectors
};

struct EncoderTraits {
  std::int32_t in_dims = 3;
  std::int32_t out_dims = 0;
  Domain domain = Domain::metric;
  /// forward of very many rows spreads over threads by itself, and is then faster by row than for one tile: training
  /// calls it once per step with all rows where it can, outside parallel regions.
  bool whole_batch = false;
  /// Of an encoder that learns: backward gives dx alone where tensors.grad is empty. Poses of cameras can be learned
  /// with it, and with every encoder that learns nothing.
  bool gives_dx_alone = false;
};

/// Shapes: M samples. Coordinates are float64 whatever Real is, because fp32 positions carry only about 19 useful bands
/// of a 10 m room; the output and all gradients are Real (float in use, double as the oracle).
template <class Real>
class Encoder : public Parametric<Real> {
 public:
  virtual EncoderTraits traits() const noexcept = 0;
  /// y = encode(x). x [M, in_dims] float64, y [M, out_dims], overwritten. Runs inside one thread of a tile, or see
  /// EncoderTraits::whole_batch.
  void forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x, View<Real> y) const;

  /// tensors.grad += dL/dtheta and, when dx is not empty, dx = dL/dx. x as in forward, dy [M, out_dims], dx [M,
  /// in_dims]. With gradients of tensors it is called once per step with all its samples, outside parallel regions: it
  /// may use parallel_for, and must give the same bits for any thread count. With dx alone (tensors.grad empty,
  /// EncoderTraits::gives_dx_alone) it is called for a tile, as forward is. Recomputes what it needs from x (encoders
  /// are memory-bound; nothing is saved by forward).
  void backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x, View<const Real> dy,
                View<Real> dx) const;

 protected:
  virtual void do_forward(const StepContext&, const Tensors<Real>&, View<const double> x, View<Real> y) const = 0;
  virtual void do_backward(const StepContext&, const Tensors<Real>&, View<const double> x, View<const Real> dy,
                           View<Real> dx) const = 0;
};

/// What the factory may know besides the parameters.
struct EncoderBuild {
  Device device = Device::cpu;
  std::int32_t in_dims = 3;
  bool is_direction = false;      ///< encodes unit view directions rather than positions
  double extent_m = 0;            ///< longest side of the scene bounds, 0 = unknown
  double pixel_footprint_m = 0;   ///< size of a pixel at the mean working distance, 0 = unknown
  double largest_coordinate = 0;  ///< of the bounds' corners, as an encoder of Domain::metric gets them; 0 = unknown
};

extern template class Encoder<float>;
extern template class Encoder<double>;

}  // namespace semfield
