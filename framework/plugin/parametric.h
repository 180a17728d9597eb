// Components with tensors: declared by name, stored by the framework, borrowed in every call.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>

#include "core/non_copyable.h"
#include "core/rng.h"
#include "core/view.h"
#include "core/workspace.h"

namespace semfield {

struct StepContext {
  std::uint64_t seed = 0;
  std::int64_t step = 0;
  bool training = false;           ///< false: no jitter, no noise; results depend on the inputs alone
  std::int64_t first_ray = 0;      ///< number of the call's ray 0 within the step's batch (or within the frame)
  std::uint32_t pass = 0;          ///< 0 = first (coarse) pass
  Workspace* workspace = nullptr;  ///< scratch of this lane; take inside a Workspace::Scope

  /// Address of random values of component `name` at this step and pass.
  RandomAddress random(std::string_view name) const {
    return {seed, static_cast<std::uint64_t>(step), stream_id(name) + 0x9E3779B9u * pass};
  }
};

enum class TensorRole : std::uint8_t {
  dense,       ///< learned; Adam updates every element each step
  sparse,      ///< learned; Adam updates only rows that received a gradient this step (hash tables)
  derived,     ///< computed from learned tensors once per step (products of weights), with a gradient; not stored in
               ///< checkpoints
  rearranged,  ///< the same without a gradient, and perhaps no floats: a weight as products read it
  state,       ///< neither learned nor derived (an occupancy grid); stored in checkpoints
};
constexpr bool is_learned(TensorRole role) { return role == TensorRole::dense || role == TensorRole::sparse; }
constexpr bool has_gradient(TensorRole role) { return is_learned(role) || role == TensorRole::derived; }
constexpr bool is_stored(TensorRole role) { return is_learned(role) || role == TensorRole::state; }

/// How a learned tensor starts. Values are addressed by (seed, tensor's full name, element): they do not depend on
/// which other tensors exist.
struct Init {
  double low = 0;  ///< uniform in [low, high); constant when equal
  double high = 0;
  static Init constant(double value) { return {value, value}; }
  static Init uniform(double bound) { return {-bound, bound}; }
};

struct TensorSpec {
  std::string name;  ///< local, snake_case; '/' separates levels ("trunk_0/weight")
  std::int64_t rows = 0;
  std::int32_t cols = 0;
  Init init{};
  TensorRole role = TensorRole::dense;
};

class ParamDeclarer {
 public:
  virtual ~ParamDeclarer() = default;
  /// Returns the tensor's index within this component: 0, 1, 2, ... in order of declaration.
  virtual int tensor(TensorSpec spec) = 0;
};

/// A component's tensors in the order it declared them. `grad` is empty outside training; gradients of state tensors
/// are empty views.
template <class Real>
struct Tensors {
  std::span<const View<Real>> value;
  std::span<const View<Real>> grad;
};

/// Base of encoders, fields, samplers and the semantic head. All calls are const: a component owns its parameter struct
/// and constants only.
template <class Real>
class Parametric {
 public:
  virtual ~Parametric() = default;
  virtual void declare(ParamDeclarer&) const {}
  /// Fills derived tensors from learned ones; called once per step before any forward, and after a checkpoint is
  /// loaded.
  virtual void derive(const StepContext&, const Tensors<Real>&) const {}
  /// Adds to the learned tensors' gradients what the derived tensors' gradients imply; called once per step, after
  /// every backward.
  virtual void derive_backward(const StepContext&, const Tensors<Real>&) const {}
};

}  // namespace semfield
