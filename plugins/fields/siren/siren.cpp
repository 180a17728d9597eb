// A network of sines: sine layers to the feature, a linear density, and a colour that sees the direction.
#include "plugin/mlp/field.h"
#include "plugin/module.h"

namespace semfield {

struct SirenParams {
  int layers = 4;
  int width = 128;
  double frequency = 30;
  int view_width = 64;
};

void describe(ParamVisitor& visit, SirenParams& p) {
  SEMFIELD_PARAM(visit, p, layers, "number of sine layers", {1, 32});
  SEMFIELD_PARAM(visit, p, width, "width of the sine layers and of the feature", {1, 4096});
  SEMFIELD_PARAM(visit, p, frequency, "w0 of sin(w0 z) [Sitzmann20]", {0.1, 1000});
  SEMFIELD_PARAM(visit, p, view_width, "width of the layer between feature, direction and colour", {1, 4096});
}

/// h_i = sin(w0 (h_{i-1} W_i + b_i)), h_{-1} the encoded position; the last h is the feature; sigma = h W_density + b;
/// rgb = sigmoid(relu([h, d] W_view + b) W_color + b), d the encoded direction.
template <class Real>
class Siren final : public MlpField<Real> {
 public:
  static constexpr bool kInBf16 = false;  // its 8 bits would be those of a phase of several turns

  Siren(const SirenParams& p, const FieldBuild& build, const KernelTables& kernels)
      : MlpField<Real>(build, kernels, "field 'siren'") {
    using enum LayerActivation;
    const Rows h = this->net().chain({"sine", {this->position()}, p.width, sine, p.frequency}, p.layers);
    const Rows sigma = this->layer({"density", {h}, 1, none});
    const Rows view = this->layer({"view", {h, this->direction()}, p.view_width, relu});
    this->give(sigma, this->layer({"color", {view}, 3, sigmoid}), h);
  }
};

SEMFIELD_PLUGIN_MODULE(siren, "1.0", [](Registry& registry) {
  registry.add_field<Siren, SirenParams>("siren", "Network of sines: density, view-dependent colour.");
})

}  // namespace semfield
