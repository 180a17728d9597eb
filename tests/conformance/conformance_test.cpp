// The laws of its kind for every registered encoder, field, sampler, head and loss on the CPU.
#include <gtest/gtest.h>

#include <set>

#include "tests/conformance/builds.h"

namespace semfield::testkit {
namespace {

std::string name_of(const testing::TestParamInfo<Row>& info) { return info.param.text(); }

class EncoderConformance : public testing::TestWithParam<Row> {};
TEST_P(EncoderConformance, Laws) {
  LawOptions options;
  options.gradient_elements = 12;
  hold_for_any_accepted(linked_registry(), GetParam(), encoder_builds(Device::cpu),
                        [&](const Encoder<float>& single, const Encoder<double>& oracle, const EncoderBuild&) {
                          return encoder_laws(single, oracle, options);
                        });
}

class FieldConformance : public testing::TestWithParam<Row> {};
TEST_P(FieldConformance, Laws) {
  LawOptions options;
  options.gradient_elements = 6;
  hold_for_any_accepted(linked_registry(), GetParam(), field_builds(linked_registry(), GetParam().name, Device::cpu),
                        [&](const Field<float>& single, const Field<double>& oracle, const FieldBuild& build) {
                          return field_laws(single, oracle, build, options);
                        });
}

class SamplerConformance : public testing::TestWithParam<Row> {};
TEST_P(SamplerConformance, Laws) {
  hold_for_any_accepted(linked_registry(), GetParam(), std::vector{sampler_build(Device::cpu)},
                        [](const Sampler<float>& single, const Sampler<double>& oracle, const SamplerBuild& build) {
                          return sampler_laws(single, oracle, build);
                        });
}

class HeadConformance : public testing::TestWithParam<Row> {};
TEST_P(HeadConformance, Laws) {
  hold_for_any_accepted(linked_registry(), GetParam(), head_builds(Device::cpu),
                        [](const Head<float>& single, const Head<double>& oracle, const HeadBuild& build) {
                          return head_laws(single, oracle, build);
                        });
}

// The head of class logits is no plugin.
TEST(HeadOfLogits, KeepsTheLaws) {
  for (const HeadBuild& build : head_builds(Device::cpu)) {
    const HeadShape shape{.feature = build.feature_dims, .hidden = 16, .width = build.width};
    const Failures failures = head_laws(OneLayerHead<float>(shape), OneLayerHead<double>(shape), build);
    EXPECT_TRUE(failures.empty()) << to_text(failures);
  }
}

class LossConformance : public testing::TestWithParam<Row> {};
TEST_P(LossConformance, Laws) {
  const Failures failures = loss_laws(linked_registry(), GetParam().name, GetParam().settings);
  EXPECT_TRUE(failures.empty()) << to_text(failures);
}

INSTANTIATE_TEST_SUITE_P(Linked, EncoderConformance, testing::ValuesIn(rows_of(PluginKind::encoder)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, FieldConformance, testing::ValuesIn(rows_of(PluginKind::field)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, SamplerConformance, testing::ValuesIn(rows_of(PluginKind::sampler)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, HeadConformance, testing::ValuesIn(rows_of(PluginKind::head)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, LossConformance, testing::ValuesIn(rows_of(PluginKind::loss)), name_of);

// Zero cases, or a plugin without a row, is a failure and not a pass.
TEST(Conformance, EveryRegisteredPluginHasARow) {
  const std::vector<const PluginEntry*> entries = linked_registry().entries();
  ASSERT_FALSE(entries.empty());
  for (const PluginKind kind : kPluginKinds) {
    std::set<std::string> with_row;
    for (const Row& row : rows_of(kind)) with_row.insert(row.name);
    EXPECT_FALSE(with_row.empty()) << "no " << kind_name(kind) << " is registered";
    for (const PluginEntry* entry : entries) {
      if (entry->kind != kind) continue;
      EXPECT_TRUE(with_row.contains(entry->name)) << kind_name(kind) << " '" << entry->name << "' has no row";
    }
  }
}

TEST(Conformance, EveryDeclarationKeepsItsLaws) {
  for (const PluginEntry* entry : linked_registry().entries()) {
    const Failures failures = declaration_laws(*entry);
    EXPECT_TRUE(failures.empty()) << kind_name(entry->kind) << " '" << entry->name << "':\n" << to_text(failures);
  }
}

}  // namespace
}  // namespace semfield::testkit
