// Parameters, traits, tensors and registration of the hash grid.
#include "encoders/hash_grid/hash_grid.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "core/check.h"
#include "plugin/module.h"
#include "plugin/registry.h"
#include "plugin/row_encoder.h"

namespace semfield {

void describe(ParamVisitor& visit, HashGridParams& p) {
  SEMFIELD_PARAM(visit, p, levels, "L, number of resolutions [Mueller22 Tab. 1]; 0 = by the device",
                 {0, kHashGridMaxLevels});
  SEMFIELD_PARAM(visit, p, features, "F, features per entry: 1, 2, 4 or 8 [Mueller22 Tab. 1]",
                 {1, kHashGridMaxFeatures});
  SEMFIELD_PARAM(visit, p, log2_entries, "log2 of T, the most entries per level [Mueller22 Tab. 1]; 0 = from the scene",
                 {0, 24});
  SEMFIELD_PARAM(visit, p, base_resolution, "cells along an axis of the coarsest level [Mueller22 Tab. 1]",
                 {1, 1048576});
  SEMFIELD_PARAM(
      visit, p, finest_resolution,
      "cells along an axis of the finest level; growth between levels follows from it [Mueller22 Eq. 3]; 0 = from "
      "the scene",
      {0, 1048576});
  SEMFIELD_PARAM(visit, p, interpolation, "weights between vertices: linear, or smoothstep with continuous slopes");
  SEMFIELD_PARAM(visit, p, init, "entries start uniform in [-init, init) [Mueller22 Sec. 4]", {0, 1});
}

void validate(const HashGridParams& p, Diagnostics& diagnostics) {
  if (p.features != 1 && p.features != 2 && p.features != 4 && p.features != 8) {
    diagnostics.error("config.value.choice", "features", "must be 1, 2, 4 or 8, got " + std::to_string(p.features),
                      "2 suits most scenes");
  }
  if (p.finest_resolution != 0 && p.finest_resolution < p.base_resolution) {
    diagnostics.error(
        "config.value.order", "finest_resolution",
        std::to_string(p.finest_resolution) + " is coarser than base_resolution " + std::to_string(p.base_resolution),
        "give at least base_resolution");
  }
  if (p.levels == 1 && p.finest_resolution > p.base_resolution) {
    diagnostics.error("config.value.conflict", "levels",
                      "1 level has one resolution, but base_resolution " + std::to_string(p.base_resolution) +
                          " and finest_resolution " + std::to_string(p.finest_resolution) + " differ",
                      "make them equal or use more levels");
  }
}

namespace {

constexpr double kCellsPerPixel = 1.25;
constexpr int kLevelsOnCpu = 8, kLevelsOnGpu = 16;           // docs/decisions.md, 0036
constexpr double kCellSteps = 8;                             // a frame more or less must not change the network
constexpr int kUnknownResolution = 2048;                     // of the paper [Mueller22 Tab. 1]
constexpr std::int64_t kLevelBytes = std::int64_t{1} << 20;  // a core's L2 cache
constexpr int kLeastLog2Entries = 14, kMostLog2Entries = 19;

int chosen_resolution(const HashGridParams& p, const EncoderBuild& build) {
  const double cells =
      build.extent_m > 0 && build.pixel_footprint_m > 0
          ? kCellSteps * std::round(kCellsPerPixel * build.extent_m / build.pixel_footprint_m / kCellSteps)
          : kUnknownResolution;
  return static_cast<int>(std::clamp(cells, static_cast<double>(p.base_resolution), 1048576.0));
}

int chosen_log2_entries(const HashGridParams& p, const EncoderBuild& build) {
  const double side = p.finest_resolution + 1.0;
  int bits = kLeastLog2Entries;
  while (bits < kMostLog2Entries && std::ldexp(1.0, bits) < 12 * side * side) ++bits;
  const auto entry_bytes = static_cast<std::int64_t>(sizeof(float)) * p.features;
  while (build.device == Device::cpu && (entry_bytes << bits) > kLevelBytes) --bits;
  return bits;
}

}  // namespace

void choose_for(HashGridParams& p, Device device, std::vector<std::string>& chosen) {
  if (p.levels != 0) return;
  p.levels = device == Device::cpu ? kLevelsOnCpu : kLevelsOnGpu;
  chosen.push_back("levels was set to " + std::to_string(p.levels) + ", which suits a " +
                   (device == Device::cpu ? "CPU" : "GPU"));
}

void choose(HashGridParams& p, const EncoderBuild& build, std::vector<std::string>& chosen) {
  char text[160];
  if (p.finest_resolution == 0) {
    p.finest_resolution = p.levels == 1 ? p.base_resolution : chosen_resolution(p, build);
    const double cell_m = build.extent_m / p.finest_resolution;
    if (build.pixel_footprint_m > 0 && cell_m > 0) {
      std::snprintf(text, sizeof text,
                    "finest_resolution was set to %d for this scene: a cell is %.3g wide, and a pixel at the middle "
                    "depth is %.3g "
                    "wide",
                    p.finest_resolution, cell_m, build.pixel_footprint_m);
    } else {
      std::snprintf(text, sizeof text, "finest_resolution was set to %d, because the scene's extent is unknown",
                    p.finest_resolution);
    }
    chosen.emplace_back(text);
  }
  if (p.log2_entries == 0) {
    p.log2_entries = chosen_log2_entries(p, build);
    std::snprintf(text, sizeof text, "log2_entries was set to %d, so that a level takes at most %lld KiB",
                  p.log2_entries, static_cast<long long>((std::int64_t{4} * p.features << p.log2_entries) / 1024));
    chosen.emplace_back(text);
  }
}

HashGridShape hash_grid_shape(const HashGridParams& p) {
  HashGridShape shape;
  shape.levels = p.levels;
  shape.features = p.features;
  shape.interpolation = p.interpolation;
  const std::int64_t most = std::int64_t{1} << p.log2_entries;
  for (int l = 0; l < p.levels; ++l) {
    HashGridLevel& level = shape.level[l];
    level.resolution = level_resolution(p.base_resolution, p.finest_resolution, l, p.levels);
    const std::uint64_t vertices = vertex_count(level.resolution);
    level.dense = vertices <= static_cast<std::uint64_t>(most);
    level.entries = level.dense ? static_cast<std::int64_t>(vertices) : most;
  }
  return shape;
}

template <class Real>
HashGrid<Real>::HashGrid(const HashGridParams& written, const EncoderBuild& build, const KernelTables& kernels)
    : kernels_(&kernels.get<HashGridKernels<Real>>(build.device, "encoder 'hash_grid'")), init_(written.init) {
  HashGridParams params = written;
  std::vector<std::string> chosen;  // said by whoever asked for the choice before
  choose_for(params, build.device, chosen);
  choose(params, build, chosen);
  require_in_dims("encoder 'hash_grid'", build, 3);
  Diagnostics diagnostics;
  validate(params, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, "encoder 'hash_grid'");
  SEMFIELD_CHECK(params.levels >= 1 && params.levels <= kHashGridMaxLevels && params.log2_entries >= 1 &&
                     params.log2_entries <= 24 && params.base_resolution >= 1 && params.finest_resolution <= 1048576,
                 "ranges are checked while reading");
  shape_ = hash_grid_shape(params);
}

template <class Real>
void HashGrid<Real>::declare(ParamDeclarer& declarer) const {
  for (int l = 0; l < shape_.levels; ++l) {
    const std::string number = std::to_string(l);
    declarer.tensor({(l < 10 ? "level_0" : "level_") + number, shape_.level[l].entries, shape_.features,
                     Init::uniform(init_), TensorRole::sparse});
  }
}

namespace {
template <class Real>
void check_tables(const HashGridShape& shape, std::span<const View<Real>> tables) {
  SEMFIELD_CHECK(tables.size() == static_cast<std::size_t>(shape.levels), "one tensor a level");
  for (std::size_t l = 0; l < tables.size(); ++l) {
    SEMFIELD_CHECK(tables[l].rows == shape.level[l].entries && tables[l].cols == shape.features &&
                       tables[l].contiguous() && !tables[l].empty(),
                   "tensors come as declared, without gaps between rows");
  }
}
}  // namespace

template <class Real>
void HashGrid<Real>::do_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                                View<Real> y) const {
  check_tables(shape_, tensors.value);
  const std::int64_t bad = kernels_->forward(shape_, tensors.value.data(), x, y, *ctx.workspace);
  if (bad >= 0) throw coordinates_not_finite("encoder 'hash_grid'", bad);
}

template <class Real>
void HashGrid<Real>::do_backward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                                 View<const Real> dy, View<Real> dx) const {
  if (!tensors.grad.empty()) {
    check_tables(shape_, tensors.grad);
    kernels_->backward_tables(shape_, tensors.grad.data(), x, dy, *ctx.workspace);
  }
  if (dx.empty()) return;
  check_tables(shape_, tensors.value);
  kernels_->backward_input(shape_, tensors.value.data(), x, dy, dx);
}

template class HashGrid<float>;
template class HashGrid<double>;

SEMFIELD_PLUGIN_MODULE(hash_grid, "1.0", [](Registry& registry) {
  hash_grid_kernels(registry.kernels());
  registry.add_encoder<HashGrid, HashGridParams>(
      "hash_grid", "Learned features on nested grids, interpolated; fine grids share a table by hashing.");
})

}  // namespace semfield
