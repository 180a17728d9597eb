// Every form in which a field on the device hands its feature on, against the feature in full.
#include <algorithm>
#include <string>
#include <vector>

#include "device_field.h"
#include "execution/device_library.h"
#include "tests/conformance/builds.h"

namespace semfield {
namespace {

using testing::DeviceField;
using testing::DeviceMatrix;
using testkit::Row;

constexpr std::int64_t kRows = 333, kSemanticRows = 250;
constexpr std::int32_t kHidden = 128;

double value_of(__nv_bfloat16 number) { return static_cast<double>(__bfloat162float(number)); }

// [N, F] [F, H] of the rounded feature, plus the bias, cut at 0.
std::vector<double> hidden_of(const std::vector<float>& feature, const std::vector<float>& weight,
                              const std::vector<float>& bias) {
  const std::size_t width = weight.size() / kHidden;
  std::vector<double> out;
  for (std::size_t m = 0; m < kSemanticRows; ++m) {
    for (std::size_t h = 0; h < kHidden; ++h) {
      double sum = static_cast<double>(bias[h]);
      for (std::size_t f = 0; f < width; ++f)
        sum += value_of(__float2bfloat16(feature[m * width + f])) * static_cast<double>(weight[f * kHidden + h]);
      out.push_back(std::max(sum, 0.0));
    }
  }
  return out;
}

void expect_forms(const Field<float>& field, testkit::FieldBench<double>& bench) {
  const DeviceField plain(field, bench), other(field, bench);
  plain.derive();
  other.derive();
  plain.forward();
  const std::vector<float> feature = plain.feature->read();
  const std::int32_t width = plain.feature->view().cols;
  ASSERT_NE(field.feature_form(kHidden), FeatureForm::full);
  FieldOut<float> out = other.out({true, true, false});
  {
    const DeviceMatrix<__nv_bfloat16> room(kRows, width);
    out.rounded_feature = testing::as_rounded(room.view());
    field.forward(other.ctx, other.tensors(), other.in(), out, other.space());
    const std::vector<__nv_bfloat16> got = room.read();
    for (std::size_t i = 0; i < got.size(); ++i)
      ASSERT_EQ(value_of(got[i]), value_of(__float2bfloat16(feature[i]))) << i;
    EXPECT_EQ(other.sigma->read(), plain.sigma->read());
    EXPECT_EQ(other.rgb->read(), plain.rgb->read());
    out.rounded_feature = {};
  }
  if (field.feature_form(kHidden) != FeatureForm::hidden_layer) return;
  const std::vector<float> weights = testing::random_floats(std::int64_t{width} * kHidden, 7, -0.1, 0.1);
  const std::vector<float> biases = testing::random_floats(kHidden, 8, -0.1, 0.1);
  const DeviceMatrix<float> weight(weights, kHidden), bias(biases, kHidden);
  const DeviceMatrix<__nv_bfloat16> hidden(kSemanticRows, kHidden);
  out.hidden = testing::as_rounded(hidden.view());
  out.layer.weight = weight.view();
  out.layer.bias = bias.view();
  field.forward(other.ctx, other.tensors(), other.in(), out, other.space());
  std::vector<double> got;
  for (const __nv_bfloat16 number : hidden.read()) got.push_back(value_of(number));
  const std::vector<double> want = hidden_of(feature, weights, biases);
  const double largest = *std::max_element(want.begin(), want.end());
  for (std::size_t i = 0; i < want.size(); ++i) ASSERT_NEAR(got[i], want[i], 0.02 * largest) << i;
  EXPECT_EQ(hidden.surroundings(), "");
  EXPECT_EQ(other.sigma->read(), plain.sigma->read());
  EXPECT_EQ(other.rgb->read(), plain.rgb->read());
}

TEST(CudaFieldForms, AreTheFeatureInFull) {
  SEMFIELD_NEEDS_DEVICE();
  KernelTables tables = testkit::linked_registry().kernels();
  cuda_library().add_kernels(tables);
  int with_forms = 0;
  std::vector<Row> rows = testkit::rows_of(PluginKind::field);
  for (const std::string& name : testkit::linked_registry().names(PluginKind::field))
    rows.push_back({PluginKind::field, name, Device::cuda, -1, {}});  // as it ships: its fastest kernels
  for (const Row& row : rows) {
    if (!tables.has(Device::cuda, "field '" + row.name + "'", Precision::bf16)) continue;  // CudaConformance names it
    const PluginEntry& entry = testkit::linked_registry().get(PluginKind::field, row.name);
    const std::unique_ptr<PluginParams> params = testkit::make_params(entry, row.settings);
    FieldBuild build;
    build.position_dims = 63;
    build.direction_dims = 16;
    const std::unique_ptr<Field<double>> oracle = entry.field64(*params, build, tables);
    testkit::FieldBench<double> bench(*oracle, build, kRows, 0, {});
    build.device = Device::cuda;
    build.precision = Precision::bf16;
    const std::unique_ptr<Field<float>> field = entry.field32(*params, build, tables);
    if (field->feature_form(kHidden) == FeatureForm::full) continue;
    SCOPED_TRACE(row.text());
    expect_forms(*field, bench);
    ++with_forms;
  }
  EXPECT_GE(with_forms, 2);
}

}  // namespace
}  // namespace semfield
