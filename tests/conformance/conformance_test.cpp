// The laws of its kind for every registered encoder, field and sampler on every device of the build.
#include <gtest/gtest.h>

#include <set>

#include "testkit/laws.h"
#include "tests/conformance/rows.h"

namespace semfield::testkit {
namespace {

std::string name_of(const testing::TestParamInfo<Row>& info) { return info.param.text(); }

// Ways of building that a factory may refuse with an Error; at least one must be accepted.
template <class Build, class Laws>
void hold_for_any_accepted(const std::vector<Build>& builds, const Laws& laws) {
  int accepted = 0;
  std::string refusals;
  for (const Build& build : builds) {
    Failures failures;
    try {
      failures = laws(build);
    } catch (const Error& error) {
      refusals += std::string(error.what()) + "\n";
      continue;
    }
    ++accepted;
    EXPECT_TRUE(failures.empty()) << "variant " << (&build - builds.data()) << ":\n" << to_text(failures);
  }
  EXPECT_GT(accepted, 0) << "every way of building was refused:\n" << refusals;
}

class EncoderConformance : public testing::TestWithParam<Row> {};
TEST_P(EncoderConformance, Laws) {
  const Row& row = GetParam();
  std::vector<EncoderBuild> builds(2);
  builds[1].is_direction = true;
  for (EncoderBuild& build : builds) {
    build.device = row.device;
    build.extent_m = 6.0;
    build.pixel_footprint_m = 0.01;
  }
  LawOptions options;
  options.gradient_elements = 12;
  hold_for_any_accepted(builds, [&](const EncoderBuild& build) {
    return encoder_laws(linked_registry(), row.name, row.settings, build, options);
  });
}

class FieldConformance : public testing::TestWithParam<Row> {};
TEST_P(FieldConformance, Laws) {
  const Row& row = GetParam();
  FieldBuild all;
  all.device = row.device;
  all.position_dims = 39;
  all.direction_dims = 16;
  FieldBuild no_direction = all;
  no_direction.direction_dims = 0;
  FieldBuild no_feature = all;
  no_feature.wants_feature = false;
  FieldBuild no_savings = all;
  no_savings.savings = {false, false, false};
  std::vector<FieldBuild> builds{all, no_direction, no_feature, no_savings};
  const std::string tables = linked_registry().kernels().devices_of("field '" + row.name + "'");
  if (tables.find(std::string(device_name(row.device)) + " bf16") != std::string::npos) {
    for (FieldBuild build : {all, no_direction, no_savings}) {
      build.precision = Precision::bf16;
      builds.push_back(build);
    }
  }
  LawOptions options;
  options.gradient_elements = 6;
  hold_for_any_accepted(builds, [&](const FieldBuild& build) {
    return field_laws(linked_registry(), row.name, row.settings, build, options);
  });
}

class SamplerConformance : public testing::TestWithParam<Row> {};
TEST_P(SamplerConformance, Laws) {
  const Row& row = GetParam();
  SamplerBuild build;
  build.device = row.device;
  build.bounds = {{-3, -2, -1.2}, {3, 2, 1.2}};
  build.near_m = 0.1;
  build.far_m = 5.0;
  const Failures failures = sampler_laws(linked_registry(), row.name, row.settings, build);
  EXPECT_TRUE(failures.empty()) << to_text(failures);
}

INSTANTIATE_TEST_SUITE_P(Linked, EncoderConformance, testing::ValuesIn(rows_of(PluginKind::encoder)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, FieldConformance, testing::ValuesIn(rows_of(PluginKind::field)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, SamplerConformance, testing::ValuesIn(rows_of(PluginKind::sampler)), name_of);

// Zero cases, or a plugin without a row, is a failure and not a pass.
TEST(Conformance, EveryRegisteredPluginHasARow) {
  const std::vector<const PluginEntry*> entries = linked_registry().entries();
  ASSERT_FALSE(entries.empty());
  for (const PluginKind kind : {PluginKind::encoder, PluginKind::field, PluginKind::sampler, PluginKind::dataset}) {
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
