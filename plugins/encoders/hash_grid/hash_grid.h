// Multiresolution hash grid: learned feature vectors on the vertices of nested grids.
#pragma once

#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "encoders/hash_grid/hash_grid_kernels.h"
#include "plugin/encoder.h"
#include "plugin/kernels.h"

namespace semfield {

struct HashGridParams {
  int levels = 16;
  int features = 2;
  int log2_entries = 19;
  int base_resolution = 16;
  int finest_resolution = 2048;
  Interpolation interpolation = Interpolation::linear;
  double init = 1e-4;
};

SEMFIELD_CHOICES(Interpolation, "linear", "smoothstep");

void describe(ParamVisitor& visit, HashGridParams& params);
void validate(const HashGridParams& params, Diagnostics& diagnostics);

/// Puts numbers where finest_resolution or log2_entries is 0, and adds a sentence for each.
/// finest_resolution: cells of 4/5 of a pixel at the scene's middle depth (a multiple of 8; 2048 cells where its extent
/// or the pixel is unknown), at least base_resolution. log2_entries: the first power of two that holds the vertices on
/// both sides of six walls of the finest level, 12 (N + 1)^2, but not below 2^14, and on a CPU at most 1 MiB a level in
/// float: a core's L2 cache.
void choose_for(HashGridParams& params, Device device, std::vector<std::string>& chosen);
void choose(HashGridParams& params, const EncoderBuild& build, std::vector<std::string>& chosen);

/// The grids that the parameters ask for, coarsest first.
HashGridShape hash_grid_shape(const HashGridParams& params);

/// y [M, levels * features], level by level: the feature vectors of the 8 vertices around x, interpolated. x [M, 3]
/// float64 in the unit cube; outside it is clamped (and dx is 0 along that axis); not finite is Error(data) naming the
/// row. One tensor a level, "level_00" .., [entries, features], role sparse. The cell is found in float64, so positions
/// keep their accuracy at every resolution; weights and sums are Real. [Mueller22]
template <class Real>
class HashGrid final : public Encoder<Real> {
 public:
  HashGrid(const HashGridParams& params, const EncoderBuild& build, const KernelTables& kernels);
  EncoderTraits traits() const noexcept override {
    return {3, shape_.levels * shape_.features, Domain::unit_cube, true, true};
  }
  void declare(ParamDeclarer& declarer) const override;
  const HashGridShape& shape() const noexcept { return shape_; }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                  View<Real> y) const override;
  void do_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x, View<const Real> dy,
                   View<Real> dx) const override;

 private:
  const HashGridKernels<Real>* kernels_;
  HashGridShape shape_;
  double init_;
};

extern template class HashGrid<float>;
extern template class HashGrid<double>;

}  // namespace semfield
