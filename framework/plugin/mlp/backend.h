// What a walk through a network asks of a backend: rows of a device and precision, and the products of layers. Private
// to the files that make the kernel tables.
#pragma once

#include <cstddef>

#include "plugin/mlp/graph.h"

namespace semfield {

/// y = start + x W of one input, for the layer's columns [first, first + cols): `exact`, or `y` after the ReLU or as it
/// is. start: the bias [1, cols], a row per sample (which may be `exact`), or row row_of[m].
template <class B>
struct MlpProduct {
  View<const typename B::Act> x;
  View<const typename B::Real> start;
  bool starts_from_bias = false;
  View<const std::int32_t> row_of;
  Rows columns;
  bool relu = false;
  View<typename B::Act> y;
  View<typename B::Real> exact;
};
/// start + dz W^T: `exact`, or `y` where `mask` is empty or positive, else 0.
template <class B>
struct MlpInputGradient {
  View<const typename B::Act> dz;
  View<const typename B::Real> start;
  View<const typename B::Act> mask;
  View<typename B::Act> y;
  View<typename B::Real> exact;
};

/// A backend of no work, with the memory of B's rows: what a walk takes from an arena that only counts.
template <class B>
struct NoWork {
  using Act = typename B::Act;
  using Real = typename B::Real;
  static constexpr bool kRounds = B::kRounds;
  static constexpr bool kColumnsAlone = B::kColumnsAlone;
  struct Weights {
    Weights(const MlpGraph&, const Tensors<Real>&, auto&) {}
  };
  static std::size_t row_bytes(std::int64_t rows, std::int32_t cols) { return B::row_bytes(rows, cols); }
  static View<Act> rows_at(std::byte* memory, std::int64_t rows, std::int32_t cols) {
    return B::rows_at(memory, rows, cols);
  }
  static void product(const auto&...) {}
  static void input_gradient(const auto&...) {}
  static void weight_gradient(const auto&...) {}
  static void ray_product(const auto&...) {}
  static void ray_weight_gradient(const auto&...) {}
  static void per_ray_sum(const auto&...) {}
  static void gather(const auto&...) {}
  static void round(const auto&...) {}
  static void copy(const auto&...) {}
  static void add(const auto&...) {}
  static void zero(const auto&...) {}
  static void hand_on(const auto&...) {}
  static void take(const auto&...) {}
  static void through(const auto&...) {}
  static void sine(const auto&...) {}
  static void sigmoid(const auto&...) {}
  static void logit_gradient(const auto&...) {}
};

/// As Workspace, but it gives one piece of memory that nobody touches, and counts.
class CountingArena {
 public:
  std::byte* take_bytes(std::size_t bytes) {
    used_ += (bytes > 0 ? bytes + 63 : 64) / 64 * 64;
    if (used_ > most_) most_ = used_;
    return nowhere_;
  }
  template <class T>
  View<T> take(std::int64_t rows, std::int32_t cols) {
    return {reinterpret_cast<T*>(take_bytes(sizeof(T) * static_cast<std::size_t>(rows * cols))), rows, cols};
  }
  std::size_t most() const { return most_; }
  struct Scope {
    explicit Scope(CountingArena& of) : arena(of), used(of.used_) {}
    ~Scope() { arena.used_ = used; }
    Scope(const Scope&) = delete;
    Scope& operator=(const Scope&) = delete;
    CountingArena& arena;
    std::size_t used;
  };

 private:
  alignas(64) std::byte nowhere_[64]{};
  std::size_t used_ = 0, most_ = 0;
};
}  // namespace semfield
