// Votes of class probabilities, and labels spread by diffusion.

#include "surface/fuse/fusion.h"

#include <Eigen/Dense>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>

#include "core/rng.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_source.h"
#include "surface/surface_graph.h"
#include "tests/analytic_scene.h"
#include "tests/says.h"

namespace semfield {
namespace {

using Row = std::array<double, 3>;

ClassVotes three(double floor = 1e-6, double confidence = 0.8) { return {3, floor, HardLikelihood(confidence, 3)}; }

Row bayesian(const ClassVotes& votes) {
  Row p{1, 1, 1};
  votes.bayesian(p);
  return p;
}
TEST(ClassVotes, FloorKeepsOneViewFromRulingOutAClass) {
  // Nine views give class 0 0.9; one gives it nothing. With a floor of 1e-3: 0.9^9 * 1e-3 = 3.9e-4 against
  // 0.1^9 * 1 = 1e-9. With 1e-12 the one view wins: 3.9e-13 < 1e-9.
  for (const auto& [floor, label] : {std::pair{1e-3, 0}, std::pair{1e-12, 1}}) {
    ClassVotes votes = three(floor);
    for (int i = 0; i < 9; ++i) votes.add(Row{0.9, 0.1, 0});
    votes.add(Row{0, 1, 0});
    EXPECT_EQ(votes.bayesian_label(kVoid), label) << floor;
    const double zero = std::pow(0.9, 9) * floor, one = std::pow(0.1, 9);
    const double two = std::pow(floor, 10);
    EXPECT_NEAR(bayesian(votes)[0], zero / (zero + one + two), 1e-12);
    EXPECT_EQ(votes.average_label(kVoid), 0);
  }
}

TEST(ClassVotes, ManyViewsNeitherOverflowNorVanish) {
  ClassVotes votes = three();
  for (int i = 0; i < 100000; ++i) votes.add(Row{0.4, 0.35, 0.25});
  const Row p = bayesian(votes);
  EXPECT_DOUBLE_EQ(p[0], 1);
  EXPECT_DOUBLE_EQ(p[0] + p[1] + p[2], 1);
}

TEST(ClassVotes, AConfidenceThatSaysNothingIsRefused) {
  EXPECT_HAS(error_of([] { HardLikelihood(0.25, 4); }), "0.25", "each has");
  EXPECT_DOUBLE_EQ(HardLikelihood(0.7, 4).miss, 0.1);
  EXPECT_DOUBLE_EQ(HardLikelihood(0.3, 1).hit, 0.3);
}

// Votes on a graph: a chain by hand, a direct factorisation as the oracle, parts that no vote reaches, threads.

constexpr RandomAddress kAddress{7, 0, stream_id("test/graph")};

// A ring of nodes with chords, weights over three decades, votes of whole and broken numbers on every ninth node.
struct Graph {
  int nodes = 400, classes = 3;
  std::vector<GraphEdge> edges;
  std::vector<double> votes;
  Graph() : votes(static_cast<std::size_t>(nodes * classes)) {
    for (int n = 0; n < nodes; ++n) {
      for (const int chord : {1, 17}) {
        const auto index = static_cast<std::uint64_t>(2 * n + (chord > 1 ? 1 : 0));
        edges.push_back({n, (n + chord) % nodes, std::pow(10.0, -3 * double(uniform01(kAddress, index)))});
      }
      if (n % 9 != 0) continue;
      const auto cls = uniform_below(kAddress, static_cast<std::uint64_t>(5000 + n), 3);
      votes[static_cast<std::size_t>(n) * 3 + cls] = n % 2 == 0 ? 1 : 0.3;
      votes[static_cast<std::size_t>(n) * 3 + (cls + 1) % 3] += n % 4 == 0 ? 0.2 : 0;
    }
  }
  Diffusion spread(double weight) const { return diffuse_votes(edges, votes, classes, weight, {}); }
};

TEST(LabelDiffusion, AgreesWithADirectFactorisation) {
  const Graph graph;
  for (const double weight : {0.01, 1.0, 1e4}) {
    std::vector<Eigen::Triplet<double>> entries;
    Eigen::MatrixXd right = Eigen::MatrixXd::Zero(graph.nodes, graph.classes);
    for (const GraphEdge& e : graph.edges) {
      entries.emplace_back(e.a, e.b, -e.weight);
      entries.emplace_back(e.b, e.a, -e.weight);
      entries.emplace_back(e.a, e.a, e.weight);
      entries.emplace_back(e.b, e.b, e.weight);
    }
    for (int n = 0; n < graph.nodes; ++n) {
      for (int c = 0; c < graph.classes; ++c) {
        right(n, c) = weight * graph.votes[n * graph.classes + c];
        entries.emplace_back(n, n, right(n, c));
      }
    }
    Eigen::SparseMatrix<double> matrix(graph.nodes, graph.nodes);
    matrix.setFromTriplets(entries.begin(), entries.end());
    const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> oracle(matrix);
    const Eigen::MatrixXd exact = oracle.solve(right);
    const Diffusion out = graph.spread(weight);
    for (int n = 0; n < graph.nodes; ++n) {
      float sum = 0;
      for (int c = 0; c < graph.classes; ++c) {
        const float p = out.probability[n * graph.classes + c];
        ASSERT_NEAR(p, exact(n, c), 2e-4) << "node " << n << ", class " << c << ", weight " << weight;
        sum += p;
      }
      ASSERT_NEAR(sum, 1, 1e-6);
    }
  }
}

TEST(LabelDiffusion, PartsWithoutAVoteStayEmpty) {
  // 0 - 1 with a vote, 2 - 3 without, 4 alone without, 5 alone with.
  const std::vector<GraphEdge> edges{{0, 1, 0.5}, {3, 2, 1}};
  std::vector<double> votes(12);
  votes[2] = 3;   // node 1, class 0
  votes[11] = 1;  // node 5, class 1
  int told = 0;
  const Diffusion out = diffuse_votes(edges, votes, 2, 1, [&](int done, int of) {
    EXPECT_EQ(done, ++told);
    EXPECT_EQ(of, 2);
  });
  EXPECT_EQ(told, 2);
  const std::vector<float> expected{1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 1};
  for (std::size_t i = 0; i < expected.size(); ++i) EXPECT_NEAR(out.probability[i], expected[i], 1e-6F) << i;
  EXPECT_EQ(out.parts, 4);
  EXPECT_EQ(out.parts_without_vote, 2);
  EXPECT_EQ(diffuse_votes(edges, std::vector<double>(12), 2, 1, {}).probability, std::vector<float>(12));
}

// Reprojection: two views of a plane by hand, an independent matrix product, hidden surfaces, choice of views.

Camera camera(std::int32_t size = 8, double focal = 8) {
  return Camera{.width_px = size, .height_px = size, .fx = focal, .fy = focal, .cx = size / 2.0, .cy = size / 2.0};
}

Pose at(double x, double y, double z) { return Pose{.t = {x, y, z}}; }

TEST(Correspondence, BoundsAreThePixelsEdges) {
  const Camera c = camera();
  // u = 8 x / z + 4 with z = 1: x = -0.5 is the left edge, x = 0.5 the right one (outside).
  const auto hit = project_point(c, {}, {-0.5, 0, 1});
  ASSERT_TRUE(hit);
  EXPECT_EQ(hit->column, 0);
  EXPECT_EQ(hit->row, 4);
  EXPECT_TRUE(project_point(c, {}, {0.5 - 1e-9, 0, 1}));
  for (const Vec3d outside : {Vec3d{-0.5 - 1e-9, 0, 1}, {0.5, 0, 1}, {NAN, 0, 1}, {1e300, 0, 1e-300}})
    EXPECT_FALSE(project_point(c, {}, outside)) << outside.x;
  for (const double behind : {-1.0, 0.0}) EXPECT_FALSE(project_point(c, {}, {0, 0, behind}));
}

TEST(Correspondence, AnotherDepthIsAnotherSurface) {
  FusionParams params{.tolerance = 0.05, .relative_tolerance = 0.01};
  // At z = 2 the two allow 0.07 m.
  std::vector<float> depth(64, 2.0F);
  const PosedDepth first{camera(), {}, depth};
  const Vec3d point = *surface_point(first, 4, 4);
  for (const float z : {2.06F, 1.94F, 2.08F, 1.92F, 0.5F, 0.0F, -1.0F, INFINITY, NAN}) {
    std::vector<float> other(64, z);
    EXPECT_EQ(seen_at({camera(), {}, other}, point, params).has_value(), z == 2.06F || z == 1.94F) << z;
    if (!(z > 0) || !std::isfinite(z)) {
      EXPECT_FALSE(surface_point({camera(), {}, other}, 0, 0)) << z;
    }
  }
  params.tolerance = 10;  // a pixel without depth agrees with nothing, however wide the tolerance
  std::vector<float> none(64, 0.0F);
  EXPECT_FALSE(seen_at({camera(), {}, none}, point, params));
}

// The same chain as 4 x 4 matrices: x_b ~ K [I | 0] B^-1 A (z K^-1 [u, v, 1], 1).
TEST(Correspondence, AgreesWithMatrices) {
  const RandomAddress address{7, 0, stream_id("test/correspondence")};
  int hits = 0;
  for (std::uint64_t trial = 0; trial < 2000; ++trial) {
    auto random = [&, k = std::uint64_t{0}](double lo, double hi) mutable {
      return lo + (hi - lo) * static_cast<double>(uniform_below(address, 32 * trial + k++, 1U << 30)) / (1U << 30);
    };
    Camera c = camera(64, random(20, 90));
    c.fy = random(20, 90);
    c.cx = random(28, 36);
    c.cy = random(28, 36);
    Eigen::Matrix4d pose[2];
    Pose ours[2];
    for (int i = 0; i < 2; ++i) {
      const Eigen::Vector3d axis = Eigen::Vector3d(random(-1, 1), random(-1, 1), random(-1, 1)).normalized();
      pose[i].setIdentity();
      pose[i].topLeftCorner<3, 3>() = Eigen::AngleAxisd(random(0, 0.6), axis).toRotationMatrix();
      pose[i].topRightCorner<3, 1>() = Eigen::Vector3d(random(-1, 1), random(-1, 1), random(-1, 1));
      for (std::size_t row = 0; row < 3; ++row) {
        for (std::size_t col = 0; col < 3; ++col)
          ours[i].r[row][col] = pose[i](static_cast<long>(row), static_cast<long>(col));
      }
      ours[i].t = {pose[i](0, 3), pose[i](1, 3), pose[i](2, 3)};
    }
    const auto z = static_cast<float>(random(1, 5));
    std::vector<float> depth(64 * 64, z);
    const auto column = static_cast<int>(random(0, 64)), row = static_cast<int>(random(0, 64));
    Eigen::Matrix3d k;
    k << c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1;
    const Eigen::Vector3d in_a = z * (k.inverse() * Eigen::Vector3d(column + 0.5, row + 0.5, 1));
    const Eigen::Vector4d world = pose[0] * in_a.homogeneous();
    const Eigen::Vector3d in_b = (pose[1].inverse() * world).head<3>();
    const Eigen::Vector3d image = k * in_b / in_b.z();
    const std::optional<Vec3d> point = surface_point({c, ours[0], depth}, column, row);
    ASSERT_TRUE(point);
    EXPECT_LT(length(*point - Vec3d{world.x(), world.y(), world.z()}), 1e-12);
    const auto hit = project_point(c, ours[1], *point);
    const bool inside = in_b.z() > 0 && image.x() >= 0 && image.x() < 64 && image.y() >= 0 && image.y() < 64;
    ASSERT_EQ(hit.has_value(), inside);
    if (!hit) continue;
    ++hits;
    EXPECT_EQ(hit->column, static_cast<int>(std::floor(image.x())));
    EXPECT_EQ(hit->row, static_cast<int>(std::floor(image.y())));
    EXPECT_NEAR(hit->z_m, in_b.z(), 1e-12);
  }
  EXPECT_GT(hits, 300);
}

TEST(Correspondence, ALensDoesNotFoldPointsBackIntoTheImage) {
  Camera c = camera();
  c.k1 = -0.3;  // r (1 - 0.3 r^2) turns round at r = 1.054
  const auto inside = project_point(c, {}, {0.4, 0, 1});
  ASSERT_TRUE(inside);
  EXPECT_FALSE(project_point(c, {}, {1.7, 0, 1}));  // 1.7 - 0.3 * 4.913 = 0.226: on the image, but no ray's
  std::vector<float> depth(64, 3.0F);
  const PosedDepth view{c, at(1, 1, 1), depth};
  for (int i = 0; i < 8; ++i) {
    const auto point = surface_point(view, i, 7 - i);
    ASSERT_TRUE(point);
    EXPECT_NEAR(view.world_from_camera.apply_inverse(*point).z, 3, 1e-12);
    const auto hit = seen_at(view, *point, {});
    ASSERT_TRUE(hit);
    EXPECT_EQ(hit->column, i);
    EXPECT_EQ(hit->row, 7 - i);
  }
}

TEST(Correspondence, ChosenViews) {
  std::vector<float> depth(64, 2.0F);
  std::vector<PosedDepth> views;
  for (const double x : {0.0, 5.0, 1.0, 0.2, 9.0}) views.push_back({camera(), at(x, 0, 0), depth});
  PosedDepth turned = views[0];  // same place, looking aside: its gaze is 2 sqrt(2) away
  turned.world_from_camera.r = {{{0, 0, 1}, {0, 1, 0}, {-1, 0, 0}}};
  views.push_back(turned);
  FusionParams params;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{1, 2, 3, 4, 5}));
  params.views = 2;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{2, 3}));
  params.views = 3;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{2, 3, 5}));  // 2.83 < 10
  params.choose = ViewChoice::even;
  params.views = 2;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4}, params), (std::vector<int>{2, 4}));
  params.views = 1;
  EXPECT_EQ(choose_views(views, 0, {1, 2, 3, 4, 5}, params), (std::vector<int>{3}));
  params.views = 50;
  EXPECT_EQ(choose_views(views, 4, {0, 1}, params), (std::vector<int>{0, 1}));
}

// Whole frames fused: two views by hand, a box in front, windows, noise, threads.

constexpr auto kMonocular = static_cast<std::size_t>(FusionMethod::monocular);
constexpr auto kBayesian = static_cast<std::size_t>(FusionMethod::bayesian);
constexpr auto kAverage = static_cast<std::size_t>(FusionMethod::average);

TrainingLabels::Frame hard(std::vector<std::int16_t> labels) { return {LabelMap(std::move(labels)), {}}; }

/// Views 8 pixels wide and 1 high, focal length 8: at 2 m a pixel is 0.25 m.
struct FusionRow {
  Camera camera{8, 1, 8, 8, 4, 0.5};
  std::vector<std::vector<float>> depth;
  std::vector<TrainingLabels::Frame> prediction;
  std::vector<double> x;

  void add(double x_m, std::vector<float> depth_m, TrainingLabels::Frame labels) {
    x.push_back(x_m);
    depth.push_back(std::move(depth_m));
    prediction.push_back(std::move(labels));
  }
  FusedFrame fuse(int target, int classes, const FusionParams& params = {.tolerance = 0.01}) const {
    std::vector<FusionView> views;
    for (std::size_t i = 0; i < x.size(); ++i) {
      Pose pose{.t = {x[i], 0, 0}};
      views.push_back({{camera, pose, depth[i]}, &prediction[i]});
    }
    return LabelFusion(views, classes, params).fuse(target);
  }
};

std::vector<float> wall(float z = 2) { return std::vector<float>(8, z); }
using Labels = std::vector<std::int16_t>;

// A row is three digits, in eighths: exact in binary16.
TrainingLabels::Frame soft(const std::vector<std::string>& rows) {
  SoftMap map(rows.size(), 3);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    std::array<float, 3> row{};
    for (std::size_t c = 0; c < 3; ++c) row[c] = static_cast<float>(rows[i][c] - '0') / 8;
    map.set_row(i, row);
  }
  return {{}, map};
}

TEST(LabelFusion, TwoViewsOfAWallByHand) {
  FusionRow row;
  // Column i of view 0 is column i - 2 of view 1.
  row.add(0, wall(), soft({"422", "422", "422", "422", "440", "242", "000", "800"}));
  row.add(0.5, wall(), soft({"161", "422", "026", "000", "116", "080", "008", "008"}));
  const FusedFrame out = row.fuse(0, 3);
  EXPECT_EQ(out.label[kMonocular], (Labels{0, 0, 0, 0, 0, 1, kVoid, 0}));
  // 2: 0.0625, 0.1875, 0.03125 and means 0.3125, 0.5, 0.1875 | 3: agrees | 4: (0, 0.125, 0) and (0.25, 0.375, 0.375)
  // | 5: own alone | 6: the other alone | 7: floor, floor against 1 * 0 and 0 * 1: 0 and 1 equal, own wins; means 0.5.
  EXPECT_EQ(out.label[kBayesian], (Labels{0, 0, 1, 0, 1, 1, 2, 0}));
  EXPECT_EQ(out.label[kAverage], (Labels{0, 0, 1, 0, 1, 1, 2, 0}));
  EXPECT_EQ(out.counts, (FusionCounts{8, 0, 1, 1, 7 + 5}));
}

TEST(LabelFusion, HardLabelsVote) {
  FusionRow row;
  row.add(0, wall(), hard({0, 0, 0, 0, 0, 0, kVoid, kVoid}));
  row.add(0.5, wall(), hard({1, 1, 1, 1, 1, 1, kVoid, kVoid}));
  row.add(1.0, wall(), hard({1, 0, 1, kVoid, 1, 1, 1, 1}));
  const FusedFrame out = row.fuse(0, 2);
  // Columns 2, 3: one against one, the own label stays; 4 and 6: the third view decides; 7: nobody knows but view 1.
  const Labels expected{0, 0, 0, 0, 1, 0, 1, 1};
  EXPECT_EQ(out.label[kBayesian], expected);
  EXPECT_EQ(out.label[kAverage], expected);
  EXPECT_EQ(out.counts.filled, 2);
}

TEST(LabelFusion, ABoxInFrontHidesTheWall) {
  // View 1 sees a box 1 m away in its columns 2 to 5; view 0 sees the wall alone. In both the wall is 2 m away.
  FusionRow row;
  row.add(0, wall(), hard({0, 0, 0, 0, 0, 0, 0, 0}));
  std::vector<float> boxed = wall();
  std::fill(boxed.begin() + 2, boxed.begin() + 6, 1.0F);
  for (int k = 0; k < 2; ++k) row.add(0.5, boxed, hard({1, 1, 1, 1, 1, 1, 1, 1}));
  FusedFrame out = row.fuse(0, 2);
  EXPECT_EQ(out.label[kBayesian], (Labels{0, 0, 1, 1, 0, 0, 0, 0}));  // wall columns 4..7 lie behind the box
  EXPECT_EQ(out.counts.votes, 8 + 2 * 2);
  // The box's own pixels (x = 0.5 - 0.1875 m and on) fall on columns 6.. of view 0, which sees the wall there.
  out = row.fuse(1, 2);
  EXPECT_EQ(out.label[kBayesian], (Labels{1, 1, 1, 1, 1, 1, 1, 1}));
  FusionParams loose{.tolerance = 1.5};
  out = row.fuse(0, 2, loose);
  EXPECT_EQ(out.label[kBayesian], (Labels{0, 0, 1, 1, 1, 1, 1, 1}));
}

TEST(LabelFusion, PixelsWithoutDepthKeepTheirLabel) {
  FusionRow row;
  std::vector<float> holes = wall();
  holes[3] = 0;
  holes[4] = NAN;
  row.add(0, holes, hard({0, 0, 0, 0, 0, 0, kVoid, 0}));
  for (int k = 0; k < 2; ++k) row.add(0, wall(), hard(Labels(8, 1)));
  const FusedFrame out = row.fuse(0, 2);
  EXPECT_EQ(out.label[kBayesian], (Labels{1, 1, 1, 0, 0, 1, 1, 1}));
  EXPECT_EQ(out.label[kAverage], out.label[kBayesian]);
  EXPECT_EQ(out.counts, (FusionCounts{8, 2, 1, 1, 5 * 3 + 2}));
  EXPECT_DOUBLE_EQ(out.counts.views_mean(), 17.0 / 6);
  // Nor can a view without depth be used.
  EXPECT_EQ(row.fuse(1, 2).label[kBayesian], (Labels(8, 1)));
  EXPECT_EQ(row.fuse(1, 2).counts.votes, 8 + 8 + 5);
}

TEST(LabelFusion, OneViewIsTheIdentityAndVoidStaysVoid) {
  FusionRow row;
  row.add(0, wall(), soft({"422", "000", "222", "004", "080", "241", "008", "800"}));
  FusedFrame out = row.fuse(0, 3);
  EXPECT_EQ(out.label[kMonocular], (Labels{0, kVoid, 0, 2, 1, 1, 2, 0}));
  EXPECT_EQ(out.label[kBayesian], out.label[kMonocular]);
  EXPECT_EQ(out.label[kAverage], out.label[kMonocular]);
  EXPECT_EQ(out.counts, (FusionCounts{8, 0, 1, 0, 7}));
  FusionRow empty;
  for (int k = 0; k < 3; ++k) empty.add(0.5 * k, wall(), hard(Labels(8, kVoid)));
  empty.add(0, wall(), {});
  out = empty.fuse(1, 3);
  for (const Labels& label : out.label) EXPECT_EQ(label, Labels(8, kVoid));
  EXPECT_EQ(out.counts, (FusionCounts{8, 0, 8, 0, 0}));
}

TEST(LabelFusion, AWindowAveragesOneSurface) {
  FusionRow row;
  row.add(0, wall(), hard(Labels(8, kVoid)));
  std::vector<float> step = wall();
  for (std::size_t i = 5; i < 8; ++i) step[i] = 3;
  row.add(0, step, hard({2, 0, 0, 2, 1, 1, 1, 1}));
  FusionParams params{.tolerance = 0.01, .neighbourhood = 3, .hard_confidence = 0.8};
  // 0: {2, 0} equal, the first | 1: {2, 0, 0} | 2: {0, 0, 2} | 3: {0, 2, 1} equal | 4: {2, 1}, column 5 is another
  // surface | 5..7: seen by nobody.
  const FusedFrame out = row.fuse(0, 3, params);
  EXPECT_EQ(out.label[kAverage], (Labels{0, 0, 0, 0, 1, kVoid, kVoid, kVoid}));
  EXPECT_EQ(out.label[kBayesian], out.label[kAverage]);
  EXPECT_EQ(out.counts.votes, 5);
}

TEST(LabelFusion, WrongInputsAreRefused) {
  FusionRow row;
  row.add(0, wall(), hard(Labels(8, 3)));
  EXPECT_HAS(error_of([&] { row.fuse(0, 3); }), "there are");
  FusionRow small;
  small.add(0, wall(), hard(Labels(7, 0)));
  EXPECT_HAS(error_of([&] { small.fuse(0, 3); }), "size of its camera");
}

// Labels spread over surfaces: cells and normals, a painted wall, the analytic room, pooled votes by hand, refusals.

TEST(SurfaceCells, TouchingCellsAreNeighboursOnce) {
  SurfaceCells cells(0.5);
  EXPECT_EQ(cells.add(Vec3d{0.1, 0.1, 0.1}), 0);
  EXPECT_EQ(cells.add(Vec3d{-0.1, 0.1, 0.1}), 1);  // the other side of 0 is another cell
  EXPECT_EQ(cells.add(Vec3d{0.4, 0.4, 0.4}), 0);
  EXPECT_EQ(cells.add(Vec3d{0.6, 0.6, 0.6}), 2);     // touches 0 in a corner
  EXPECT_EQ(cells.add(Vec3d{-0.6, -0.1, -0.1}), 3);  // touches 1 in a corner; two cells from 0
  EXPECT_EQ(cells.add(Vec3d{5, 5, 5}), 4);           // alone
  EXPECT_EQ(cells.add(Vec3d{1e7, 0, 0}), -1);
  EXPECT_EQ(cells.add(Vec3d{0, std::numeric_limits<double>::quiet_NaN(), 0}), -1);
  EXPECT_EQ(cells.count(), 5);
  std::vector<std::pair<int, int>> pairs;
  for (const CellPair& pair : cells.neighbours())
    pairs.emplace_back(std::min(pair.a, pair.b), std::max(pair.a, pair.b));
  std::sort(pairs.begin(), pairs.end());
  EXPECT_EQ(pairs, (std::vector<std::pair<int, int>>{{0, 1}, {0, 2}, {1, 3}}));
}

TEST(SurfaceCells, ManyKeepTheirNumbers) {
  SurfaceCells cells(1);
  std::vector<SurfaceCell> places;
  for (std::int32_t i = 0; i < 20000; ++i) places.push_back({i % 31 - 15, i / 31 % 29 - 14, i / 899 * 40000 - 400000});
  for (std::size_t i = 0; i < places.size(); ++i) ASSERT_EQ(cells.add(places[i]), static_cast<std::int32_t>(i));
  for (std::size_t i = 0; i < places.size(); ++i) {
    ASSERT_EQ(cells.add(places[i]), static_cast<std::int32_t>(i));
    ASSERT_EQ(cells.near({places[i][0] + 0.5, places[i][1] + 0.5, places[i][2] + 0.5}), static_cast<std::int32_t>(i));
  }
  EXPECT_EQ(cells.near({0.5, 0.5, 1000.5}), -1);
}

TEST(SurfaceCells, NormalsOfTheAnalyticRoom) {
  Diagnostics diagnostics;
  const LoadedScene scene = load_scene(*testkit::make_analytic_scene(), {}, diagnostics);
  const FrameInfo& info = scene.info.frames[1];
  const std::vector<float> depth = scene.frames[1].depth_m.expand();
  const PosedDepth view{info.camera, info.world_from_camera, depth};
  const SeenSurface seen = seen_surface(surface_points(view), info.camera.width_px, info.world_from_camera.t);
  int near = 0, asked = 0;
  for (std::int32_t row = 0; row < info.camera.height_px; ++row) {
    for (std::int32_t column = 0; column < info.camera.width_px; ++column) {
      const Vec3d ray = normalized(info.world_from_camera.rotate(info.camera.direction(column + 0.5, row + 0.5)));
      const testkit::AnalyticHit hit = testkit::intersect_analytic_room(info.world_from_camera.t, ray);
      ++asked;
      near += dot(hit.normal, seen.normal[view.pixel(column, row)]) > 0.95 ? 1 : 0;
    }
  }
  EXPECT_GT(near, asked * 9 / 10) << "of " << asked;
}

// A wall 2.1 m before one camera of 16 x 8 pixels, focal length 16.8: a pixel is 0.125 m, and no face of a cell lies in
// the wall. The left half is dark, the right half bright.
struct PaintedWall {
  LoadedScene scene;
  TrainingLabels labels;
  FrameMaps maps;
  PropagationParams params;

  static constexpr std::size_t kWidth = 16, kHeight = 8, kPixels = kWidth * kHeight;
  PaintedWall() {
    scene.info.frames = {{.name = "wall", .camera = {kWidth, kHeight, 16.8, 16.8, 8, 4}}};
    scene.info.classes = ClassTable({{1, "dark", {}, false}, {2, "bright", {}, false}, {3, "other", {}, false}});
    StoredFrame frame;
    frame.width_px = kWidth;
    frame.height_px = kHeight;
    frame.rgb.assign(3 * kPixels, 40);
    for (std::size_t p = 0; p < kPixels; ++p) {
      if (p % kWidth >= kWidth / 2) std::fill_n(frame.rgb.begin() + static_cast<std::ptrdiff_t>(3 * p), 3, 200);
    }
    scene.frames.push_back(std::move(frame));
    maps.frames = {0};
    maps.depth_m = {std::vector<float>(kPixels, 2.1F)};
    maps.label.resize(1);
    params.cell_m = 0.125;
    give(std::vector<std::int16_t>(kPixels, kVoid));
  }
  void give(std::vector<std::int16_t> given) {
    labels.class_pixels = {std::vector<std::int64_t>(4)};
    for (const std::int16_t c : given) ++labels.class_pixels[0][c < 0 ? 3 : static_cast<std::size_t>(c)];
    labels.frames = {{LabelMap(std::move(given)), {}}};
  }
  void click(const std::map<std::size_t, std::int16_t>& clicks) {
    std::vector<std::int16_t> given(kPixels, kVoid);
    for (const auto& [pixel, label] : clicks) given[pixel] = label;
    give(given);
  }
  TrainingLabels spread() const { return propagate_labels(scene, labels, maps, params, {}); }
};

std::string fact(const TrainingLabels& labels, const std::string& name) {
  for (const auto& [key, value] : labels.steps.back().facts) {
    if (key == name) return value;
  }
  return "no fact '" + name + "'";
}

TEST(Propagation, ColourDrawsTheBorderBetweenTwoClicks) {
  PaintedWall wall;
  wall.click({{3 * 16 + 7, 0}, {4 * 16 + 15, 1}});  // dark, at the border; bright, at the far end
  TrainingLabels out = wall.spread();
  ASSERT_TRUE(out.soft);
  for (std::size_t p = 0; p < PaintedWall::kPixels; ++p) {
    EXPECT_EQ(out.frames[0][p], p % 16 < 8 ? 0 : 1) << p;
    EXPECT_EQ(out.frames[0].soft.at(p, 2), 0) << "nobody voted for the third class";
  }
  EXPECT_EQ(fact(out, "cells"), "128");
  EXPECT_EQ(fact(out, "cells with votes"), "2");
  EXPECT_EQ(fact(out, "connected parts"), "1");
  EXPECT_EQ(out.steps.back().type, "propagate surface");
  // Without colour the border lies between the clicks: the click beside it takes the bright pixels next to it.
  wall.params.color_sigma = 1000;
  out = wall.spread();
  EXPECT_EQ(out.frames[0][3 * 16 + 8], 0);
}

TEST(Propagation, DepthThatIsMissingAndPartsWithoutAVote) {
  PaintedWall wall;
  wall.click({{0, 2}, {7, 1}});  // the second on a pixel that will have no depth
  std::vector<float>& depth = wall.maps.depth_m[0];
  for (std::size_t row = 0; row < 8; ++row) {
    depth[row * 16 + 6] = depth[row * 16 + 7] = 0;
    for (std::size_t column = 8; column < 16; ++column) depth[row * 16 + column] = 3;  // out of touch
  }
  const TrainingLabels out = wall.spread();
  for (std::size_t p = 0; p < PaintedWall::kPixels; ++p)
    EXPECT_EQ(out.frames[0][p], p == 7 ? 1 : p % 16 < 6 ? 2 : kVoid) << p;
  EXPECT_EQ(fact(out, "pixels without depth"), "16");
  EXPECT_NE(fact(out, "parts without a vote"), "0");
}

TEST(Propagation, SureEnoughOnly) {
  PaintedWall wall;
  wall.click({{0, 0}, {15, 1}});
  wall.params.color_sigma = 1000;
  wall.params.min_confidence = 0.6;
  const TrainingLabels out = wall.spread();
  EXPECT_EQ(out.frames[0][0], 0);
  EXPECT_EQ(out.frames[0][4 * 16 + 8], kVoid) << "half-way nothing is sure";
}

TEST(Propagation, VotesPooledByHand) {
  PaintedWall wall;
  wall.params.method = PropagationMethod::vote;
  wall.params.vote_cells_m = {0.25, 0.5};  // 2 x 2 pixels, 4 x 4 pixels; the wall's borders are multiples of both
  wall.params.least_votes = 3;
  // Three votes in the first small cell; one alone in the second, whose large cell has four; one alone in both.
  wall.click({{0, 0}, {1, 0}, {16, 1}, {2, 2}, {15, 1}});
  const TrainingLabels out = wall.spread();
  const auto row = [&](std::size_t pixel) {
    return std::array<float, 3>{out.frames[0].soft.at(pixel, 0), out.frames[0].soft.at(pixel, 1),
                                out.frames[0].soft.at(pixel, 2)};
  };
  const float third = float_of_half(half_of(1 / 3.0F)), two = float_of_half(half_of(2 / 3.0F));
  EXPECT_EQ(row(0), (std::array<float, 3>{two, third, 0}));
  EXPECT_EQ(row(16), row(0));
  EXPECT_EQ(row(2), (std::array<float, 3>{0.5F, 0.25F, 0.25F}));
  EXPECT_EQ(row(15), (std::array<float, 3>{0, 1, 0}));
  EXPECT_EQ(row(17), (std::array<float, 3>{0, 0, 0})) << "a pixel without a label gets none";
  EXPECT_EQ(fact(out, "pixels by cells of 0.25 m"), "3");
  EXPECT_EQ(fact(out, "pixels by cells of 0.5 m"), "2");
  EXPECT_EQ(out.steps.back().type, "propagate vote");
}

TEST(Propagation, SoftLabelsVoteWithTheirProbabilities) {
  PaintedWall wall;
  SoftMap soft(PaintedWall::kPixels, 3);
  soft.set_row(0, std::array<float, 3>{0.5F, 0.25F, 0.25F});
  wall.labels.frames = {{{}, soft}};
  wall.labels.class_pixels = {{1, 1, 1, 0}};
  const TrainingLabels out = wall.spread();
  for (const std::size_t p : {std::size_t{0}, PaintedWall::kPixels - 1}) {
    EXPECT_EQ(out.frames[0].soft.at(p, 0), 0.5F);
    EXPECT_EQ(out.frames[0].soft.at(p, 2), 0.25F);
  }
}

TEST(Propagation, Refusals) {
  PaintedWall wall;
  EXPECT_HAS(error_of([&] { (void)wall.spread(); }), "no training pixel carries a label");
  wall.click({{0, 0}});
  wall.params.cell_m = 0;
  EXPECT_HAS(error_of([&] { (void)wall.spread(); }), "propagate.cell_m");
  wall.scene.pixel_footprint_m = 0.1;  // three of them, or 200 m / 500
  EXPECT_EQ(fact(wall.spread(), "edge of a cell, m"), "0.3");
  wall.scene.bounds = {{0, 0, 0}, {200, 1, 1}};
  EXPECT_EQ(fact(wall.spread(), "edge of a cell, m"), "0.4");
  wall.maps.depth_m[0].assign(PaintedWall::kPixels, 0);
  EXPECT_HAS(error_of([&] { (void)wall.spread(); }), "no training pixel has depth");
}

}  // namespace
}  // namespace semfield
