// Density through the pipeline against its float64 twin, and surfaces of fields against that twin and formulas.

#include "surface/mesh/field_surface.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "core/rng.h"
#include "surface/mesh/mesh_files.h"
#include "surface/mesh/score/mesh_score.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

std::vector<double> random_points(const Box& box, std::int64_t count) {
  const RandomAddress address{3, 0, stream_id("mesh_test/points")};
  std::vector<double> points;
  for (std::uint64_t i = 0; i < static_cast<std::uint64_t>(3 * count); ++i) {
    const int axis = static_cast<int>(i % 3);
    points.push_back(box.lo[axis] + box.size()[axis] * static_cast<double>(uniform01(address, i)));
  }
  return points;
}

// The session's field, as it is now, in float64.
std::unique_ptr<Pipeline<double>> twin_of(const Session& session, const Registry& registry) {
  std::unique_ptr<Pipeline<double>> twin =
      assemble(make_parts<double>(session.config, registry, session.plan, session.extent), {}, false);
  for (Tensor<double>& t : twin->store().all()) {
    const Tensor<float>* from = session.pipeline->store().find(t.name);
    EXPECT_NE(from, nullptr) << t.name;
    if (from == nullptr) continue;
    for (std::int64_t i = 0; i < t.size(); ++i) t.value.data()[i] = static_cast<double>(from->value.data()[i]);
  }
  twin->derive(0);
  return twin;
}

void expect_twins_agree(const std::string& yaml) {
  Registry registry = make_registry();
  Session session = open_text(yaml, registry);
  const auto twin = twin_of(session, registry);
  session.pipeline->derive(0);
  constexpr std::int64_t kCount = 5003;
  const std::vector<double> points = random_points(session.extent.bounds, kCount);
  std::vector<float> sigma(kCount), again(kCount);
  std::vector<double> exact(kCount);
  session.pipeline->executor().density({points.data(), kCount, 3}, {sigma.data(), kCount, 1});
  twin->executor().density({points.data(), kCount, 3}, {exact.data(), kCount, 1});
  double largest = 0, least = HUGE_VAL;
  for (std::size_t i = 0; i < kCount; ++i) {
    ASSERT_NEAR(sigma[i], exact[i], 1e-4 * std::max(1.0, exact[i])) << i;
    largest = std::max(largest, exact[i]);
    least = std::min(least, exact[i]);
  }
  EXPECT_GT(largest, least) << "a density that differs from place to place";
  // Points of their own calls, and other threads: the same bits.
  const int threads = thread_count();
  set_thread_count(1);
  for (std::int64_t i = 0; i < kCount; i += 997) {
    const std::int64_t count = std::min<std::int64_t>(997, kCount - i);
    session.pipeline->executor().density({points.data() + 3 * i, count, 3}, {again.data() + i, count, 1});
  }
  set_thread_count(threads);
  EXPECT_EQ(sigma, again);
}

TEST(Density, FloatAgreesWithItsTwinOfAHashGrid) { expect_twins_agree(hash_config()); }
TEST(Density, FloatAgreesWithItsTwinOfTwoPasses) { expect_twins_agree(two_pass_config()); }

// A field of formulas: a ball whose density grows towards its middle, its colour a function of the place.
const Vec3d kCenter{0.31, -0.22, 0.13};
constexpr double kRadius = 0.7, kGrowth = 2000;
double red_at(double x) { return 0.5 + 0.3 * x; }

struct BallParams {};
void describe(ParamVisitor&, BallParams&) {}
void validate(const BallParams&, Diagnostics&) {}

template <class Real>
class BallField final : public Field<Real> {
 public:
  BallField(const BallParams&, const FieldBuild&, const KernelTables&) {}
  FieldTraits traits() const noexcept override { return {1, false}; }
  std::size_t saved_bytes(std::int64_t, std::int64_t) const noexcept override { return 0; }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>& in, const FieldOut<Real>& out,
                  Saved) const override {
    for (std::int64_t m = 0; m < in.position.rows; ++m) {
      const Vec3d p{static_cast<double>(in.position(m, 0)), static_cast<double>(in.position(m, 1)),
                    static_cast<double>(in.position(m, 2))};
      const double inside = kRadius * kRadius - dot(p - kCenter, p - kCenter);
      out.sigma(m, 0) = static_cast<Real>(kGrowth * inside);
      for (int c = 0; c < 3 && !out.rgb.empty(); ++c) out.rgb(m, c) = static_cast<Real>(c == 0 ? red_at(p.x) : 0.25);
      if (!out.feature.empty()) out.feature(m, 0) = static_cast<Real>(p.z > kCenter.z ? 1 : -1);
    }
  }
  void do_backward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>&, const FieldOut<Real>&,
                   const FieldGrad<Real>&, Saved, View<Real>) const override {}
};

struct Ball : ::testing::Test {
  Ball() : registry(make_registry()) {
    registry.add_field<BallField, BallParams>("ball", "a ball of formulas");
    session = std::make_unique<Session>(
        open_text("scene: {type: analytic_room, frames: 8, load: {bounds: [-1, -1.5, -1, 1.2, 1.1, 1.3]}}\n"
                  "rendering: {scene_scale: 1, unit_m: 1}\n"
                  "semantics: {hidden_width: 4}\n"
                  "passes:\n  - {name: main, sampler: {type: stratified, samples: 400}, position: {type: identity},\n"
                  "     direction: {type: identity}, field: {type: ball}}\n",
                  registry));
  }
  SurfaceRequest request(double spacing, double level) const {
    return {VoxelGrid::covering(session->extent.bounds, spacing), level, false};
  }
  std::vector<RayCamera> cameras() const {
    std::vector<RayCamera> out;
    for (const FrameInfo& info : session->scene.info.frames)
      out.push_back({info.camera, info.world_from_camera, false});
    return out;
  }
  Registry registry;
  std::unique_ptr<Session> session;
};

double radius_at(double level) { return std::sqrt(kRadius * kRadius - level / kGrowth); }

TEST_F(Ball, VerticesLieOnItInWorldMetres) {
  double before = 0;
  for (const double spacing : {0.08, 0.04, 0.02}) {
    const double level = 40;
    const Surface surface = density_surface(*session->pipeline, request(spacing, level));
    ASSERT_GT(surface.positions.size(), 500U);
    double worst = 0, sum = 0;
    for (std::size_t v = 0; v < surface.positions.size(); ++v) {
      const Vec3d out = surface.positions[v] - kCenter;
      worst = std::max(worst, std::abs(length(out) - radius_at(level)));
      sum += std::abs(length(out) - radius_at(level));
      EXPECT_GT(dot(surface.normals[v], normalized(out)), 0.9);
    }
    const double mean = sum / static_cast<double>(surface.positions.size());
    EXPECT_LT(worst, spacing / 2);
    EXPECT_TRUE(before == 0 || before / mean > 2) << spacing << " m: " << before << " then " << mean;
    before = mean;
  }
  EXPECT_LT(before, 0.002) << "metres at cells of 2 cm";
}

TEST_F(Ball, VerticesGetTheClassOfTheirPlace) {
  Surface surface = density_surface(*session->pipeline, request(0.05, 40));
  const std::vector<RayCamera> eyes = cameras();
  surface.attributes =
      render_attributes(*session->pipeline, surface, eyes, sights_of(surface, eyes, session->limits, 0.05),
                        session->limits, session->plan.class_of_logit);
  std::int16_t above = -2, below = -2;
  for (std::size_t v = 0; v < surface.positions.size(); ++v) {
    if (std::abs(surface.positions[v].z - kCenter.z) < 0.1 || surface.attributes.label[v] == kVoid) continue;
    std::int16_t& same = surface.positions[v].z > kCenter.z ? above : below;
    if (same == -2) same = surface.attributes.label[v];
    EXPECT_EQ(surface.attributes.label[v], same);
  }
  EXPECT_GE(above, 0);
  EXPECT_GE(below, 0);
}

TEST_F(Ball, ChosenLevelPutsTheSurfaceWhereItIsSeen) {
  const std::vector<DepthView> views = depth_views(*session->pipeline, cameras(), session->limits, 4096);
  const double level = choose_level(*session->pipeline, request(0.02, 0), views, session->limits);
  EXPECT_LE(level, half_opaque_density(0.02));
  double off = 0;
  int count = 0;
  for (const DepthView& view : views) {
    for (std::size_t i = 0; i < view.map.distance_m.size(); ++i) {
      if (view.map.distance_m[i] == 0) continue;
      const PixelPlace at = strided_place(static_cast<std::int64_t>(i), view.map.width_px, view.map.stride);
      const Vec3d p = point_at(view.camera, session->limits, at, static_cast<double>(view.map.distance_m[i]));
      off += std::abs(length(p - kCenter) - radius_at(level));
      ++count;
    }
  }
  ASSERT_GT(count, 200);
  EXPECT_LT(off / count, 0.02);
}

TEST_F(Ball, AnOpaqueBorderClosesTheBox) {
  SurfaceRequest closed = request(0.1, 40);
  const std::size_t ball = density_surface(*session->pipeline, closed).triangles.size();
  closed.opaque_border = true;
  const Surface both = density_surface(*session->pipeline, closed);
  EXPECT_EQ(components_of(both).faces.size(), 2U);
  EXPECT_GT(both.triangles.size(), 2 * ball);
}

TEST_F(Ball, PointCloudIsThinnedAndLabelled) {
  PointCloud fine(0.02), coarse(0.1);
  for (const RayCamera& camera : cameras()) {
    const RenderedFrame frame = render_frame(*session->pipeline, camera, session->limits, session->plan.class_of_logit);
    const SeenPixels pixels = seen_pixels(camera, frame);
    fine.add(frame, pixels);
    coarse.add(frame, pixels);
  }
  const PointSet many = fine.points(), few = coarse.points();
  ASSERT_GT(few.positions.size(), 20U);
  EXPECT_GT(many.positions.size(), 2 * few.positions.size());
  EXPECT_EQ(many.attributes.label.size(), many.positions.size());
  double off = 0, facing = 0;
  for (std::size_t i = 0; i < many.positions.size(); ++i) {
    const Vec3d p = many.positions[i];
    off += std::abs(length(p - kCenter) - kRadius);
    EXPECT_NEAR(many.attributes.color[i][0], 255 * red_at(p.x), 12);
    facing += dot(many.normals[i], normalized(p - kCenter));
    EXPECT_GT(many.footprint[i], 0);
  }
  EXPECT_GT(facing / static_cast<double>(many.positions.size()), 0.9) << "normals point out of the ball";
  EXPECT_LT(off / static_cast<double>(many.positions.size()), 0.03);
  EXPECT_THROW(PointCloud(0), Error);
}

// Depth of views of a ball before a wall, fused: where the surface lies, and what no view saw.

constexpr double kDepthFusionRadius = 0.5, kWall = 1.2;  // ball at the origin, wall z = kWall

// Distance along a unit ray; 0: it meets nothing.
double met(Vec3d origin, Vec3d direction, bool with_wall) {
  const double b = dot(origin, direction), c = dot(origin, origin) - kDepthFusionRadius * kDepthFusionRadius,
               root = b * b - c;
  if (root > 0 && -b - std::sqrt(root) > 0) return -b - std::sqrt(root);
  if (!with_wall || !(direction.z > 0)) return 0;
  return (kWall - origin.z) / direction.z;
}

// At `eye`, looking at the origin.
DepthView view_from(Vec3d eye, bool with_wall = true, std::int32_t stride = 1) {
  DepthView view;
  view.camera.camera = {120, 90, 100, 100, 60, 45};
  const Vec3d forward = eye * (-1 / length(eye));
  const Vec3d aside = cross(std::abs(forward.y) < 0.9 ? Vec3d{0, 1, 0} : Vec3d{1, 0, 0}, forward);
  const Vec3d right = aside * (1 / length(aside)), down = cross(forward, right);
  Pose& pose = view.camera.world_from_camera;
  for (std::size_t i = 0; i < 3; ++i)
    pose.r[i] = {right[static_cast<int>(i)], down[static_cast<int>(i)], forward[static_cast<int>(i)]};
  pose.t = eye;
  SurfaceMap& map = view.map;
  map.stride = stride;
  map.width_px = strided_px(120, stride);
  map.height_px = strided_px(90, stride);
  for (std::int64_t i = 0; i < std::int64_t{map.width_px} * map.height_px; ++i) {
    const PixelPlace at = strided_place(i, map.width_px, stride);
    const Vec3d local = view.camera.camera.direction(at.column + 0.5, at.row + 0.5);
    const Vec3d ray = right * local.x + down * local.y + forward * local.z;
    map.distance_m.push_back(static_cast<float>(met(eye, ray, with_wall)));
  }
  return view;
}

RayLimits limits() { return {.near_m = 0.05, .far_m = 20}; }

VoxelGrid grid(double spacing) { return VoxelGrid::covering({{-1.5, -1.5, -1.5}, {1.5, 1.5, 1.5}}, spacing); }

std::vector<DepthView> around(std::int32_t stride = 1) {
  std::vector<DepthView> views;
  for (int k = 0; k < 8; ++k) {
    const double angle = k * 0.7853981633974483;
    views.push_back(view_from({2 * std::cos(angle), 2 * std::sin(angle), -1.2}, true, stride));
  }
  return views;
}

// Of a vertex, from the ball or the wall, whichever is nearer.
double off(Vec3d p) { return std::min(std::abs(length(p) - kDepthFusionRadius), std::abs(p.z - kWall)); }

TEST(DepthFusion, OfGuessesManyMustAgree) {
  std::vector<DepthView> views = around();
  const Surface all = fused_surface(views, limits(), grid(0.05), true);
  ASSERT_GT(all.positions.size(), 500U);
  for (const Vec3d& p : all.positions) EXPECT_LT(off(p), 0.05);
  views.resize(2);
  EXPECT_FALSE(fused_surface(views, limits(), grid(0.05)).triangles.empty());
  EXPECT_TRUE(fused_surface(views, limits(), grid(0.05), true).triangles.empty());
}

TEST(DepthFusion, LiesOnWhatTheViewsShow) {
  for (const std::int32_t stride : {1, 2}) {
    const double spacing = 0.05;
    const Surface surface = fused_surface(around(stride), limits(), grid(spacing));
    ASSERT_GT(surface.triangles.size(), 2000U);
    double sum = 0, most = 0;
    std::size_t wrong = 0;
    for (std::size_t i = 0; i < surface.positions.size(); ++i) {
      const Vec3d p = surface.positions[i];
      sum += off(p), most = std::max(most, off(p));
      const Vec3d outward = std::abs(length(p) - kDepthFusionRadius) < std::abs(p.z - kWall) ? p : Vec3d{0, 0, -1};
      wrong += dot(surface.normals[i], outward) < 0 ? 1 : 0;
    }
    EXPECT_LT(wrong, surface.positions.size() / 100) << "it faces the cameras";
    EXPECT_LT(sum / static_cast<double>(surface.positions.size()), 0.15 * spacing) << stride;
    EXPECT_LT(most, kAgreeCells * spacing * 1.5) << stride;
  }
}

// Behind the ball, behind the wall and outside the images nobody knows anything.
TEST(DepthFusion, EndsWhereNobodySaw) {
  const std::vector<DepthView> one{view_from({0, 0, -2})};
  const double spacing = 0.05;
  const Surface surface = fused_surface(one, limits(), grid(spacing));
  ASSERT_GT(surface.triangles.size(), 500U);
  for (const Vec3d& p : surface.positions) {
    const bool on_ball = std::abs(length(p) - kDepthFusionRadius) < std::abs(p.z - kWall);
    EXPECT_LT(off(p), 2 * kAgreeCells * spacing) << "the slope of a corner may double it";
    EXPECT_TRUE(!on_ball || p.z < 0.05) << "the far half of the ball";
    EXPECT_TRUE(on_ball || std::hypot(p.x, p.y) > 0.6) << "the wall in the ball's shadow";
  }
  EXPECT_TRUE(fused_surface({}, limits(), grid(0.1)).triangles.empty());
}

// One view of eight shows the ball 0.3 nearer than it is: the others look through that place.
TEST(DepthFusion, OtherViewsRefuteWhatOneAloneShows) {
  std::vector<DepthView> views = around();
  for (float& d : views[0].map.distance_m) d -= 0.3F;
  const double spacing = 0.05;
  const Surface surface = fused_surface(views, limits(), grid(spacing));
  std::size_t wrong = 0;
  for (const Vec3d& p : surface.positions) wrong += off(p) > 2 * spacing ? 1 : 0;
  EXPECT_LT(wrong, surface.positions.size() / 50);
}

// Rays that meet nothing say that there is nothing.
TEST(DepthFusion, ARayThatMeetsNothingIsEmptySpace) {
  std::vector<DepthView> views;
  for (int k = 0; k < 6; ++k) views.push_back(view_from({2 * std::cos(k * 1.05), 0.4, 2 * std::sin(k * 1.05)}, false));
  const Surface surface = fused_surface(views, limits(), grid(0.05));
  ASSERT_GT(surface.triangles.size(), 500U);
  for (const Vec3d& p : surface.positions) EXPECT_NEAR(length(p), kDepthFusionRadius, 0.1);
}

// Rendered depth is a mean: at the ball's outline pixels lie between ball and wall, where there is nothing.
TEST(DepthFusion, PixelsBetweenTwoSurfacesShowNone) {
  DepthView view = view_from({0, 0, -2});
  const std::vector<float> sharp = view.map.distance_m;
  const std::int32_t width = view.map.width_px;
  std::size_t between = 0;
  for (std::size_t i = 1; i + 1 < sharp.size(); ++i) {
    if (static_cast<std::int32_t>(i) % width == 0 || !(std::abs(sharp[i - 1] - sharp[i + 1]) > 0.8F)) continue;
    view.map.distance_m[i] = (sharp[i - 1] + sharp[i + 1]) / 2;
    ++between;
  }
  ASSERT_GT(between, 50U);
  const double spacing = 0.05;
  const std::vector<DepthView> one{view};
  const Surface surface = fused_surface(one, limits(), grid(spacing));
  ASSERT_GT(surface.triangles.size(), 500U);
  std::size_t wrong = 0;
  for (const Vec3d& p : surface.positions) wrong += off(p) > 2 * kAgreeCells * spacing ? 1 : 0;
  EXPECT_LT(wrong, surface.positions.size() / 200);
}

// Distances to triangles, and scores of meshes whose share of right and missing area is known: a box seen from inside.

constexpr double kHalf = 0.503;  // of the box's side; no wall lies on the border of a cube of kPointCube

// The box of half side `half`; faces look inward, those of wall w are triangles 2 w and 2 w + 1.
Surface box(double half = kHalf) {
  Surface surface;
  for (int i = 0; i < 8; ++i)
    surface.positions.push_back(
        {(i & 1) != 0 ? half : -half, (i & 2) != 0 ? half : -half, (i & 4) != 0 ? half : -half});
  for (const auto& wall : {std::array<std::uint32_t, 4>{0, 2, 6, 4},
                           {1, 3, 7, 5},
                           {0, 1, 5, 4},
                           {2, 3, 7, 6},
                           {0, 1, 3, 2},
                           {4, 5, 7, 6}}) {
    surface.triangles.push_back({wall[0], wall[1], wall[2]});
    surface.triangles.push_back({wall[0], wall[2], wall[3]});
  }
  return surface;
}

// A square of the given side that lies level, its middle at `at`.
void add_square(Surface& surface, Vec3d at, double side) {
  const auto first = static_cast<std::uint32_t>(surface.positions.size());
  for (const auto& [x, y] : {std::pair{-0.5, -0.5}, {0.5, -0.5}, {0.5, 0.5}, {-0.5, 0.5}})
    surface.positions.push_back(at + Vec3d{x * side, y * side, 0});
  surface.triangles.push_back({first, first + 1, first + 2});
  surface.triangles.push_back({first, first + 2, first + 3});
}

// From the middle along an axis: 0 to 5 are x, -x, y, -y, z, -z. 100 degrees wide.
DepthView look(int way) {
  constexpr std::int32_t kSide = 238;
  RayCamera camera;
  camera.camera = {kSide, kSide, 100, 100, kSide / 2.0, kSide / 2.0};
  const int axis = way / 2;
  const double sign = way % 2 == 0 ? 1 : -1;
  Vec3d forward, right;
  forward[axis] = sign;
  right[(axis + 1) % 3] = 1;
  const Vec3d down = cross(forward, right);
  for (std::size_t i = 0; i < 3; ++i)
    camera.world_from_camera.r[i] = {right[static_cast<int>(i)], down[static_cast<int>(i)],
                                     forward[static_cast<int>(i)]};
  std::vector<float> z(static_cast<std::size_t>(kSide) * kSide);
  for (std::size_t i = 0; i < z.size(); ++i) {
    const Vec3d local =
        camera.camera.direction(static_cast<double>(i % kSide) + 0.5, static_cast<double>(i / kSide) + 0.5);
    const Vec3d ray = camera.world_from_camera.rotate(local);
    const double met = kHalf / std::max({std::abs(ray.x), std::abs(ray.y), std::abs(ray.z)});
    z[i] = static_cast<float>(met * local.z);
  }
  return measured_view(camera, DepthMap(z));
}

std::vector<DepthView> all_around() {
  std::vector<DepthView> views;
  for (int way = 0; way < 6; ++way) views.push_back(look(way));
  return views;
}

TEST(NearestSurface, FindsTheNearestOfManyPoints) {
  constexpr RandomAddress kPlace{1, 0, stream_id("test/nearest")};
  const auto random = [&](std::uint64_t i) { return static_cast<double>(uniform01(kPlace, i)); };
  std::vector<Vec3d> points;
  for (std::uint64_t i = 0; i < 1000; ++i) points.push_back({random(3 * i), random(3 * i + 1), random(3 * i + 2)});
  const NearestSurface nearest(points);
  for (std::uint64_t i = 0; i < 200; ++i) {
    const Vec3d at{2 * random(9000 + 3 * i) - 0.5, random(9001 + 3 * i), random(9002 + 3 * i)};
    double least = HUGE_VAL;
    for (const Vec3d& p : points) least = std::min(least, length(p - at));
    ASSERT_NEAR(nearest.distance(at, 10), least, 1e-12);
  }
}

TEST(MeshScore, TheSurfaceItselfIsCompleteAndAccurate) {
  const std::vector<DepthView> views = all_around();
  const DepthReference reference(views, {});
  EXPECT_NEAR(static_cast<double>(reference.points()), 6 * 1.006 * 1.006 * 1e4, 3000) << "a point a square centimetre";
  EXPECT_EQ(reference.held_out_points(), 0U);
  const MeshScore score = reference.score(box());
  EXPECT_EQ(score.complete, (ScoreShares{1, 1, 1}));
  EXPECT_EQ(score.accurate, (ScoreShares{1, 1, 1}));
  EXPECT_EQ(score.f, (ScoreShares{1, 1, 1}));
  EXPECT_EQ(score.judged, 1);
  EXPECT_FALSE(score.complete_of_held_out);
}

TEST(MeshScore, AnOffsetCountsFromItsDistanceOn) {
  const std::vector<DepthView> views = all_around();
  const MeshScore score = DepthReference(views, {}).score(box(kHalf - 0.03));
  EXPECT_EQ(score.complete[0], 0);
  EXPECT_GT(score.complete[1], 0.999) << "corners are farther by the root of three";
  EXPECT_EQ(score.complete[2], 1);
  EXPECT_EQ(score.accurate, (ScoreShares{0, 1, 1}));
  EXPECT_EQ(score.f[0], 0);
}

TEST(MeshScore, AMissingWallIsMissingFromCompletenessAlone) {
  const std::vector<DepthView> views = all_around();
  const std::vector<DepthView> first(views.begin(), views.begin() + 4), rest(views.begin() + 4, views.end());
  const DepthReference reference(first, rest);
  Surface surface = box();
  surface.triangles.resize(10);  // without the wall at +z, which the fifth view shows
  const MeshScore score = reference.score(surface);
  for (std::size_t k = 0; k < kScoreDistances.size(); ++k) {
    // Of the wall that is away, a rim lies so near to its neighbours.
    const double inner = 1 - kScoreDistances[k] / kHalf;
    EXPECT_NEAR(score.complete[k], 1 - inner * inner / 6, 0.01) << k;
    ASSERT_TRUE(score.complete_of_held_out);
    EXPECT_LT((*score.complete_of_held_out)[k], score.complete[k]) << k;
    EXPECT_EQ(score.accurate[k], 1) << k;
    EXPECT_NEAR(score.f[k], 2 * score.complete[k] / (1 + score.complete[k]), 1e-12) << k;
  }
}

TEST(MeshScore, WhatFloatsIsWrongAndWhatNobodyMeasuredIsNotJudged) {
  const std::vector<DepthView> views = all_around();
  const DepthReference reference(views, {});
  const double walls = 24 * kHalf * kHalf;
  Surface floats = box();
  add_square(floats, {0, 0, 0.2}, 0.5);
  const MeshScore wrong = reference.score(floats);
  for (const double accurate : wrong.accurate) EXPECT_NEAR(accurate, walls / (walls + 0.25), 1e-4);
  EXPECT_EQ(wrong.judged, 1);
  Surface outside = box();
  add_square(outside, {0, 0, 3}, 0.5);
  const MeshScore unknown = reference.score(outside);
  EXPECT_EQ(unknown.accurate, (ScoreShares{1, 1, 1}));
  EXPECT_NEAR(unknown.judged, walls / (walls + 0.25), 1e-4);
}

// A sensor that measures nothing at a pixel does not say that its ray is empty.
TEST(MeshScore, PixelsWithoutDepthTakeNothingAway) {
  std::vector<DepthView> views = all_around();
  const VoxelGrid grid = VoxelGrid::covering({{-0.6, -0.6, -0.6}, {0.6, 0.6, 0.6}}, 0.02);
  const RayLimits limits;
  const DepthReference reference(views, {});
  const MeshScore whole = reference.score(fused_surface(views, limits, grid));
  EXPECT_GT(whole.complete[0], 0.98);
  EXPECT_GT(whole.accurate[0], 0.99);
  std::vector<DepthView> twice = all_around();
  for (DepthView& view : all_around()) {
    view.map.distance_m.assign(view.map.distance_m.size(), kNotKnown);
    twice.push_back(view);
  }
  const MeshScore same = reference.score(fused_surface(twice, limits, grid));
  EXPECT_EQ(same.complete, whole.complete);
  EXPECT_EQ(same.accurate, whole.accurate);
  const std::vector<DepthView> none(twice.begin() + 6, twice.end());
  EXPECT_TRUE(fused_surface(none, limits, grid).triangles.empty());
  EXPECT_EQ(DepthReference(none, {}).points(), 0U);
}

}  // namespace
}  // namespace semfield
