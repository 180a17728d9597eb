// A small encoder with a table, and one way to break each of its promises.
#pragma once

#include <string_view>

#include "plugin/registry.h"

namespace semfield::toy {

/// The promise that a plugin breaks, by a name of its own; none by "none".
using Broken = std::string_view;

struct ToyParams {
  std::int64_t bands = 2;
  double gain = 1.5;
  bool flip = false;
};
inline void describe(ParamVisitor& visit, ToyParams& p) {
  SEMFIELD_PARAM(visit, p, bands, "number of sine bands a coordinate", {1, 8});
  SEMFIELD_PARAM(visit, p, gain, "factor of every output", {0, 4});
  SEMFIELD_PARAM(visit, p, flip, "changes the sign of every output");
}
inline void validate(const ToyParams& p, Diagnostics& diagnostics) {
  if (p.flip && p.gain == 0) diagnostics.error("test.finding.made", "gain", "0 has no sign to flip", "set flip: false");
}

/// y[b] = gain * table[b] * sum_d sin((b + 1) x[d]).
template <class Real>
class ToyEncoder : public Encoder<Real> {
 public:
  ToyEncoder(const ToyParams& params, const EncoderBuild& build, const KernelTables& kernels, Broken broken = "none")
      : params_(params), in_dims_(build.in_dims), broken_(broken) {
    (void)kernels;
  }
  EncoderTraits traits() const noexcept override {
    return {in_dims_, static_cast<std::int32_t>(params_.bands), Domain::metric};
  }
  void declare(ParamDeclarer& declarer) const override {
    declarer.tensor({"table", params_.bands, 1, Init::uniform(1.0), TensorRole::dense});
  }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                  View<Real> y) const override {
    const Workspace::Scope scope(*ctx.workspace);
    (void)ctx.workspace->take<Real>(x.rows, 1);
    for (std::int64_t r = 0; r < x.rows; ++r) {
      if (broken_ == "skip_last_row" && r + 1 == x.rows) continue;
      for (std::int32_t b = 0; b < y.cols; ++b) {
        double sum = broken_ == "depend_on_row" ? 1e-9 * static_cast<double>(r) : 0;
        for (std::int32_t d = 0; d < x.cols; ++d) sum += std::sin((b + 1) * x(r, d));
        if (broken_ == "float_off" && sizeof(Real) == 4) sum += 0.01;
        y(r, b) = static_cast<Real>(params_.gain * static_cast<double>(tensors.value[0](b, 0)) * sum);
      }
      if (broken_ == "write_past_cols") y.data[r * y.row_stride + y.cols] = Real(0);
    }
  }
  void do_backward(const StepContext&, const Tensors<Real>& tensors, View<const double> x, View<const Real> dy,
                   View<Real> dx) const override {
    const bool of_this_call = broken_ == "sums_as_they_come" && sizeof(Real) == 4 && ++calls_ % 2 == 0;
    for (std::int64_t r = 0; r < x.rows; ++r) {
      for (std::int32_t d = 0; d < x.cols && !dx.empty() && broken_ != "accumulate_dx" && broken_ != "skip_dx"; ++d)
        dx(r, d) = 0;
      for (std::int32_t b = 0; b < dy.cols; ++b) {
        double sum = 0;
        for (std::int32_t d = 0; d < x.cols; ++d) {
          sum += std::sin((b + 1) * x(r, d));
          const double slope = broken_ == "wrong_dx" ? 1 : b + 1;
          const double gradient =
              params_.gain * slope * static_cast<double>(tensors.value[0](b, 0)) * std::cos((b + 1) * x(r, d));
          if (!dx.empty() && broken_ != "skip_dx")
            dx(r, d) += static_cast<Real>(gradient * static_cast<double>(dy(r, b)));
        }
        double gain = broken_ == "wrong_table_gradient" ? 1.001 * params_.gain : params_.gain;
        if (of_this_call) gain *= 1 + 1e-6;
        const auto add = static_cast<Real>(gain * sum * static_cast<double>(dy(r, b)));
        Real& grad = tensors.grad[0](b, 0);
        grad = (broken_ == "assign_gradient" && r == 0 ? Real(0) : grad) + add;
      }
    }
  }

 private:
  ToyParams params_;
  std::int32_t in_dims_;
  Broken broken_;
  mutable int calls_ = 0;
};

inline void register_into(Registry& registry) {
  registry.add_encoder<ToyEncoder, ToyParams>("toy", "Sines with a learned amplitude.");
}

}  // namespace semfield::toy
