// One field with tensors, inputs and guarded outputs, as the field laws use it.
#pragma once

#include <memory>
#include <vector>

#include "plugin/field.h"
#include "testkit/guarded.h"
#include "testkit/laws.h"
#include "testkit/tensor_box.h"

namespace semfield::testkit {

/// Which outputs forward fills.
struct Wanted {
  bool sigma = true, rgb = true, feature = true;
};

template <class Real>
class FieldBench {
 public:
  FieldBench(const Field<Real>& field, const FieldBuild& build, std::int64_t samples, std::int32_t padding,
             const LawOptions& options);

  FieldIn<Real> in() const;
  FieldOut<Real> out(Wanted wanted = {});
  /// Fixed random weights of the outputs: dL/d(outputs) of L = sum(weight * output).
  FieldGrad<Real> output_weights(Wanted wanted = {}) const;
  Saved saved();
  void derive() { field.derive(ctx, box.tensors()); }
  void forward(Wanted wanted = {}) { field.forward(ctx, box.tensors(), in(), out(wanted), saved()); }
  void backward(Wanted wanted = {}, bool with_d_position = true);
  /// L after derive and forward.
  double loss();

  const Field<Real>& field;
  FieldTraits shape;
  Workspace workspace;
  StepContext ctx;
  TensorBox<Real> box;
  Guarded<Real> position, direction;
  Guarded<std::int32_t> ray_of_sample;
  Guarded<Real> sigma, rgb, feature;
  Guarded<Real> w_sigma, w_rgb, w_feature;
  Guarded<Real> d_position;

 private:
  std::vector<std::byte> saved_memory_;
};

extern template class FieldBench<float>;
extern template class FieldBench<double>;

}  // namespace semfield::testkit
