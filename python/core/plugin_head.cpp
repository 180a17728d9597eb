#include "python/core/plugin_head.h"

#include "python/core/plugin_calls.h"
#include "python/core/plugin_tensors.h"

namespace semfield::python {

namespace {

template <class Real>
class PythonHead final : public Head<Real> {
 public:
  PythonHead(const std::string& name, const py::object& type, const PythonParams& params, const HeadBuild& build)
      : owner_("head '" + name + "'"), width_(build.width) {
    if (build.device != Device::cpu)
      throw Error(ErrorKind::unavailable, "plugin.kernels.missing",
                  owner_ + " is written in Python and has no " + std::string(device_name(build.device)) + " kernels");
    called(owner_, [&] {
      const py::object made = type.attr("_made")(params.values(), build.feature_dims, build.width);
      hidden_ = made.attr("hidden_width").template cast<std::int32_t>();
      tensors_ = PythonTensors<Real>(made);
      instance_ = hold(made);
    });
    if (hidden_ <= 0)
      throw Error(ErrorKind::usage, "plugin.python.declaration", owner_ + ": setup must set hidden_width above 0");
  }

  std::int32_t hidden_width() const override { return hidden_; }
  std::int32_t width() const override { return width_; }
  void declare(ParamDeclarer& declarer) const override { tensors_.declare(declarer); }

  void hidden_forward(const StepContext&, const Tensors<Real>& tensors, View<const Real> feature,
                      View<Real> hidden) const override {
    called(owner_ + ".hidden", [&] {
      take(owner_ + ".hidden", instance_->attr("hidden")(borrowed(feature), tensors_.values(tensors)), hidden);
    });
  }
  void hidden_backward(const StepContext&, const Tensors<Real>& tensors, View<const Real> feature,
                       View<const Real> hidden, View<Real> d_hidden, View<Real> d_feature) const override {
    called(owner_ + ".hidden_backward", [&] {
      const std::string doing = owner_ + ".hidden_backward";
      take(doing,
           tensors_.with_gradients(doing, tensors,
                                   [&](const py::dict& grads) {
                                     return instance_->attr("hidden_backward")(borrowed(feature), borrowed(hidden),
                                                                               borrowed(View<const Real>(d_hidden)),
                                                                               tensors_.values(tensors), grads);
                                   }),
           d_feature);
    });
  }
  void output_forward(const StepContext&, const Tensors<Real>& tensors, View<const Real> h, View<const Real> opacity,
                      View<Real> rows) const override {
    called(owner_ + ".output", [&] {
      take(owner_ + ".output", instance_->attr("output")(borrowed(h), seen(opacity), tensors_.values(tensors)), rows);
    });
  }
  void output_backward(const StepContext&, const Tensors<Real>& tensors, View<const Real> h, View<const Real> opacity,
                       View<const Real> d_rows, View<Real> d_h, View<Real> d_opacity) const override {
    called(owner_ + ".output_backward", [&] {
      const std::string doing = owner_ + ".output_backward";
      const py::object answer = tensors_.with_gradients(doing, tensors, [&](const py::dict& grads) {
        return instance_->attr("output_backward")(borrowed(h), seen(opacity), borrowed(d_rows),
                                                  tensors_.values(tensors), grads);
      });
      if (!py::isinstance<py::tuple>(answer) || py::len(answer) != 2)
        throw Error(ErrorKind::failure, "plugin.python.shape",
                    doing + ": expected two arrays, dL/dh and dL/d(opacity)");
      take(doing + ", dL/dh", py::object(answer[py::int_(0)]), d_h);
      if (!d_opacity.empty()) take(doing + ", dL/d(opacity)", py::object(answer[py::int_(1)]), d_opacity);
    });
  }

 private:
  static py::object seen(View<const Real> opacity) {
    return opacity.empty() ? py::object(py::none()) : py::object(borrowed(opacity));
  }

  std::string owner_;
  std::int32_t hidden_ = 0, width_ = 0;
  PythonTensors<Real> tensors_;
  Held instance_;
};

}  // namespace

template <class Real>
std::unique_ptr<Head<Real>> make_python_head(const std::string& name, const py::object& type,
                                             const PythonParams& params, const HeadBuild& build) {
  return std::make_unique<PythonHead<Real>>(name, type, params, build);
}

template std::unique_ptr<Head<float>> make_python_head<float>(const std::string&, const py::object&,
                                                              const PythonParams&, const HeadBuild&);
template std::unique_ptr<Head<double>> make_python_head<double>(const std::string&, const py::object&,
                                                                const PythonParams&, const HeadBuild&);

}  // namespace semfield::python
