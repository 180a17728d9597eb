// The sampler laws hold for a sound sampler and catch each broken promise.
#include <gtest/gtest.h>

#include "testkit/laws.h"
#include "tests/plugin/broken_case.h"

namespace semfield {
namespace {

enum class Break {
  none,
  descending,
  consumed_order,
  outside,
  zero_delta,
  wrong_first,
  jitter_without_training,
  fill_empty_rays
};

/// `kCount` jittered samples a ray in equal intervals; an empty ray has none.
template <class Real>
class ToySampler final : public Sampler<Real> {
 public:
  explicit ToySampler(Break broken) : broken_(broken) {}
  SamplerTraits traits() const noexcept override { return {}; }
  std::int64_t capacity(std::int64_t rays, std::int64_t) const noexcept override { return rays * kCount; }

 protected:
  void do_sample(const StepContext& ctx, const Tensors<Real>&, const Rays<Real>& rays, const Proposal<Real>*,
                 Samples<Real>& out) const override {
    const RandomAddress address = ctx.random("sampler/toy");
    const bool jitter = ctx.training || broken_ == Break::jitter_without_training;
    const std::int64_t first_ray = broken_ == Break::consumed_order ? 0 : ctx.first_ray;
    std::int64_t n = 0;
    for (std::int64_t r = 0; r < rays.origin.rows; ++r) {
      out.first(r, 0) = static_cast<std::int32_t>(n);
      const double width = (rays.near_far(r, 1) - rays.near_far(r, 0)) / kCount;
      if (width <= 0 && broken_ != Break::fill_empty_rays) continue;
      for (std::int64_t k = 0; k < kCount; ++k, ++n) {
        const double u =
            jitter ? static_cast<double>(uniform01(address, static_cast<std::uint64_t>((first_ray + r) * kCount + k)))
                   : 0.5;
        const std::int64_t slot = broken_ == Break::descending ? kCount - 1 - k : k;
        const double far_off = broken_ == Break::outside && k == kCount - 1 ? 1.0 : 0.0;
        out.t(n, 0) = static_cast<Real>(rays.near_far(r, 0) + (static_cast<double>(slot) + u) * width + far_off);
        out.delta(n, 0) = broken_ == Break::zero_delta && k == 2 ? Real(0) : static_cast<Real>(width);
        out.ray_of_sample(n, 0) = static_cast<std::int32_t>(r);
      }
    }
    out.first(rays.origin.rows, 0) = static_cast<std::int32_t>(broken_ == Break::wrong_first ? n - 1 : n);
    out.count = n;
  }

 private:
  static constexpr std::int64_t kCount = 6;
  Break broken_;
};

std::string laws_of(Break broken) {
  SamplerBuild build;
  build.bounds = {{-2, -2, -1}, {2, 2, 1}};
  build.near_m = 0.1;
  build.far_m = 4.0;
  return testkit::to_text(testkit::sampler_laws(ToySampler<float>(broken), ToySampler<double>(broken), build));
}

TEST(SamplerLaws, HoldForASoundSampler) { EXPECT_EQ(laws_of(Break::none), ""); }

using Case = BrokenCase<Break>;
class BrokenSampler : public testing::TestWithParam<Case> {};

TEST_P(BrokenSampler, IsCaught) {
  const std::string failures = laws_of(GetParam().broken);
  EXPECT_NE(failures.find(GetParam().law), std::string::npos) << "failures were:\n" << failures;
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenSampler,
                         testing::Values(Case{Break::descending, "not ascending"},
                                         Case{Break::consumed_order, "a ray alone"},
                                         Case{Break::outside, "outside [near, far]"},
                                         Case{Break::zero_delta, "delta is not positive"},
                                         Case{Break::wrong_first, "first[rays] is not the count"},
                                         Case{Break::jitter_without_training, "without training, another seed"},
                                         Case{Break::fill_empty_rays, "near == far"}),
                         NameOfCase{});

}  // namespace
}  // namespace semfield
