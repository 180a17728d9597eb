// The encoder laws hold for a sound encoder and catch each broken promise.
#include <gtest/gtest.h>

#include "testkit/laws.h"
#include "tests/plugin/broken_case.h"
#include "tests/plugin/toy_encoder.h"

namespace semfield {
namespace {

using testkit::Failures;
using toy::Break;

Failures laws_of(Break broken, const testkit::LawOptions& options = {}) {
  const KernelTables kernels;
  const toy::ToyEncoder<float> encoder32(toy::ToyParams{}, EncoderBuild{}, kernels, broken);
  const toy::ToyEncoder<double> encoder64(toy::ToyParams{}, EncoderBuild{}, kernels, broken);
  return testkit::encoder_laws(encoder32, encoder64, options);
}

bool mentions(const Failures& failures, const std::string& words) {
  return testkit::to_text(failures).find(words) != std::string::npos;
}

TEST(EncoderLaws, HoldForASoundEncoder) {
  const Failures failures = laws_of(Break::none);
  EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
}

using Case = BrokenCase<Break>;
class BrokenEncoder : public testing::TestWithParam<Case> {};

TEST_P(BrokenEncoder, IsCaught) {
  const Failures failures = laws_of(GetParam().broken);
  EXPECT_TRUE(mentions(failures, GetParam().law)) << "failures were:\n" << testkit::to_text(failures);
}

INSTANTIATE_TEST_SUITE_P(
    EachPromise, BrokenEncoder,
    testing::Values(Case{Break::skip_last_row, "every output written"},
                    Case{Break::write_past_cols, "outputs stay inside"}, Case{Break::wrong_dx, "gradient of x"},
                    Case{Break::wrong_table_gradient, "gradient of table"},
                    Case{Break::assign_gradient, "gradients accumulate"},
                    Case{Break::accumulate_dx, "every dx written"}, Case{Break::skip_dx, "every dx written"},
                    Case{Break::depend_on_row, "permuted rows"}, Case{Break::float_off, "float against double, y"},
                    Case{Break::sums_as_they_come, "1 and 3 threads, gradient of table"},
                    Case{Break::hides_scratch, "scratch_bytes, 33 rows: 96 bytes, but 192"},
                    Case{Break::claims_much_scratch, "scratch_bytes, 4097 rows: "}),
    NameOfCase{});

TEST(EncoderLaws, SumsWithoutSameBitsHaveATolerance) {
  testkit::LawOptions options;
  options.same_bits_of_sums = false;
  const Failures failures = laws_of(Break::sums_as_they_come, options);
  EXPECT_FALSE(mentions(failures, "1 and 3 threads")) << testkit::to_text(failures);
}

TEST(DeclarationLaws, HoldForTheToy) {
  Registry registry;
  toy::register_into(registry);
  const Failures failures = testkit::declaration_laws(registry.get(PluginKind::encoder, "toy"));
  EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
}

TEST(EncoderLaws, BuildFromTheRegistryWithSettings) {
  Registry registry;
  toy::register_into(registry);
  const Failures failures = testkit::encoder_laws(registry, "toy", {{"bands", "5"}, {"flip", "true"}}, {});
  EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
}

TEST(Settings, RefuseUnknownNamesWrongTypesAndRanges) {
  Registry registry;
  toy::register_into(registry);
  const PluginEntry& entry = registry.get(PluginKind::encoder, "toy");
  const std::unique_ptr<PluginParams> params = entry.new_params();
  const Failures failures =
      testkit::apply_settings(*params, {{"bands", "9"}, {"gain", "much"}, {"flip", "yes"}, {"glow", "1"}});
  EXPECT_EQ(failures.size(), 4u) << testkit::to_text(failures);
  EXPECT_TRUE(mentions(failures, "bands: expected int in [1, 8], got '9'"));
  EXPECT_TRUE(mentions(failures, "unknown parameter 'glow'"));
  EXPECT_THROW(testkit::make_params(entry, {{"gain", "0"}, {"flip", "true"}}), Error);
}

}  // namespace
}  // namespace semfield
