// Grouping: what a small network over points of a surface learns from segments of images, and how its outputs tell
// which points are one object.
#pragma once

#include <cstdint>
#include <span>

#include "config/params.h"
#include "core/error.h"
#include "core/view.h"
#include "core/workspace.h"
#include "plugin/kernels.h"

namespace semfield {

/// Points of one image, N of them, each in a segment of it.
template <class Real>
struct SegmentedPoints {
  View<const Real> rows;                  ///< [N, width] outputs of the network
  View<const Real> slow;                  ///< [N, width] of its slow copy; the rows themselves where there is none
  std::span<const std::int32_t> segment;  ///< [N] 0 .. segments - 1; numbers of one image mean nothing in another
  std::int32_t segments = 0;
};

class Grouping;

/// One call of a grouping on a device: points of several images, `per_image` rows of each one after another. All views
/// are the device's memory.
struct GroupingCall {
  View<const float> rows;             ///< [images * per_image, width]
  View<const float> slow;             ///< the same of the slow copy; `rows` where there is none
  View<const std::int32_t> segment;   ///< [images * per_image, 1] 0 .. segments - 1 of its image
  View<const std::int32_t> segments;  ///< [images, 1]
  std::int64_t per_image = 0;
  std::int32_t most_segments = 0;  ///< of an image
  double scale = 1;
  View<float> gradients;  ///< as rows; added to
  View<double> loss;      ///< [images * per_image, 1] gets each point's loss; 0 at first
};
/// As Grouping::add of each image, queued where the device works; the same bits whenever it is called with the same.
using GroupingKernel = void (*)(const Grouping& grouping, const GroupingCall& call, Workspace& arena);
/// The table of a grouping on a device; NAME_cuda.cu adds that of its class as "grouping 'NAME'".
template <class Term>
struct GroupingKernels {
  GroupingKernel add = nullptr;
};

/// All calls are const. The object holds its own parameters; a copy of one that nobody has used is what
/// Registry::add_grouping makes.
class Grouping {
 public:
  virtual ~Grouping() = default;
  virtual void describe(ParamVisitor& visit) = 0;
  virtual void validate(Diagnostics&) const {}
  /// Outputs per point.
  virtual std::int32_t width() const = 0;
  /// Share of its values that the slow copy keeps in a step; 0: there is none.
  virtual double slow_share() const { return 0; }
  /// Sum over the points of an image, and `scale` times its gradients [N, width] added to `gradients`. The slow rows
  /// have none. One thread. Numbers of segments may be exchanged without a change.
  virtual double add(const SegmentedPoints<float>& points, double scale, View<float> gradients) const = 0;
  virtual double add(const SegmentedPoints<double>& points, double scale, View<double> gradients) const = 0;
  /// Outputs [N, width] become, in place, points of a space in which those of one object lie close together, within
  /// some tenths, and those of two objects farther apart, at about 1.
  virtual void place(View<float> rows) const = 0;
  /// Null where a device has no kernels for it: the CPU learns then.
  virtual GroupingKernel kernel(Device device, const KernelTables& tables) const = 0;
};

/// Base of a grouping whose one code for both precisions is `template <class Real> double sum(points, scale,
/// gradients) const`.
template <class Term>
class GroupingOf : public Grouping {
 public:
  double add(const SegmentedPoints<float>& points, double scale, View<float> gradients) const final {
    return static_cast<const Term&>(*this).template sum<float>(points, scale, gradients);
  }
  double add(const SegmentedPoints<double>& points, double scale, View<double> gradients) const final {
    return static_cast<const Term&>(*this).template sum<double>(points, scale, gradients);
  }
  GroupingKernel kernel(Device device, const KernelTables& tables) const final {
    const GroupingKernels<Term>* const table = tables.find<GroupingKernels<Term>>(device);
    return table == nullptr ? nullptr : table->add;
  }
};

}  // namespace semfield
