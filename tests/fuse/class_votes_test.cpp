// Votes of class probabilities against numbers worked out by hand, labels spread by diffusion, real predictions.
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>

#include "compute/parallel.h"
#include "core/error.h"
#include "core/rng.h"
#include "datasets/replica/replica.h"
#include "loading/frame_source.h"
#include "scene/classes/class_table.h"
#include "surface/fuse/fusion.h"
#include "surface/surface_graph.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using Row = std::array<double, 3>;

ClassVotes three(double floor = 1e-6, double confidence = 0.8) { return {3, floor, HardLikelihood(confidence, 3)}; }

TEST(ClassVotes, BayesianIsTheProduct) {
  ClassVotes votes = three();
  votes.add(Row{0.5, 0.3, 0.2});
  votes.add(Row{0.1, 0.6, 0.3});
  // 0.05, 0.18, 0.06 of 0.29.
  Row p{};
  votes.bayesian(p);
  EXPECT_NEAR(p[0], 5.0 / 29, 1e-14);
  EXPECT_NEAR(p[1], 18.0 / 29, 1e-14);
  EXPECT_NEAR(p[2], 6.0 / 29, 1e-14);
  EXPECT_EQ(votes.bayesian_label(kVoid), 1);
  EXPECT_EQ(votes.views(), 2);
}

TEST(ClassVotes, AverageIsTheMean) {
  ClassVotes votes = three();
  votes.add(Row{0.5, 0.3, 0.2});
  votes.add(Row{0.1, 0.6, 0.3});
  votes.add(Row{0.9, 0.0, 0.0});  // a tenth belongs to no class
  Row p{};
  votes.average(p);
  EXPECT_NEAR(p[0], 0.5, 1e-15);
  EXPECT_NEAR(p[1], 0.3, 1e-15);
  EXPECT_NEAR(p[2], 0.5 / 3, 1e-15);
  EXPECT_EQ(votes.average_label(kVoid), 0);
}

TEST(ClassVotes, ProductAndMeanDisagreeWhereOneViewIsSure) {
  // Two hesitant views for class 0, one sure one for class 1: 0.6 * 0.6 * 0.01 = 0.0036 against 0.4 * 0.4 * 0.98.
  ClassVotes votes = three();
  votes.add(Row{0.6, 0.4, 0});
  votes.add(Row{0.6, 0.4, 0});
  votes.add(Row{0.01, 0.98, 0.01});
  EXPECT_EQ(votes.bayesian_label(kVoid), 1);
  Row p{};
  votes.average(p);
  EXPECT_NEAR(p[0], 1.21 / 3, 1e-15);
  EXPECT_NEAR(p[1], 1.78 / 3, 1e-15);
}

TEST(ClassVotes, FloorKeepsOneViewFromRulingOutAClass) {
  // Nine views give class 0 0.9; one gives it nothing. With a floor of 1e-3: 0.9^9 * 1e-3 = 3.9e-4 against
  // 0.1^9 * 1 = 1e-9. With 1e-12 the one view wins: 3.9e-13 < 1e-9.
  for (const auto& [floor, label] : {std::pair{1e-3, 0}, std::pair{1e-12, 1}}) {
    ClassVotes votes = three(floor);
    for (int i = 0; i < 9; ++i) votes.add(Row{0.9, 0.1, 0});
    votes.add(Row{0, 1, 0});
    EXPECT_EQ(votes.bayesian_label(kVoid), label) << floor;
    Row p{};
    votes.bayesian(p);
    const double zero = std::pow(0.9, 9) * floor, one = std::pow(0.1, 9);
    const double two = std::pow(floor, 10);
    EXPECT_NEAR(p[0], zero / (zero + one + two), 1e-12);
    EXPECT_EQ(votes.average_label(kVoid), 0);
  }
}

TEST(ClassVotes, LabelsBecomeAConfusionLikelihood) {
  ClassVotes votes = three(1e-6, 0.8);
  votes.add(std::int16_t{2});
  votes.add(Row{0.5, 0.3, 0.2});
  // 0.1 * 0.5, 0.1 * 0.3, 0.8 * 0.2 of 0.24.
  Row p{};
  votes.bayesian(p);
  EXPECT_NEAR(p[0], 5.0 / 24, 1e-14);
  EXPECT_NEAR(p[1], 3.0 / 24, 1e-14);
  EXPECT_NEAR(p[2], 16.0 / 24, 1e-14);
  votes.average(p);
  EXPECT_NEAR(p[0], 0.3, 1e-15);
  EXPECT_NEAR(p[1], 0.2, 1e-15);
  EXPECT_NEAR(p[2], 0.5, 1e-15);
}

TEST(ClassVotes, ManyViewsNeitherOverflowNorVanish) {
  ClassVotes votes = three();
  for (int i = 0; i < 100000; ++i) votes.add(Row{0.4, 0.35, 0.25});
  Row p{};
  votes.bayesian(p);
  EXPECT_DOUBLE_EQ(p[0], 1);
  EXPECT_DOUBLE_EQ(p[0] + p[1] + p[2], 1);
}

TEST(ClassVotes, EqualVotesGoToThePreferredLabelThenTheFirst) {
  ClassVotes votes = three();
  votes.add(std::int16_t{2});
  votes.add(std::int16_t{1});
  EXPECT_EQ(votes.bayesian_label(2), 2);
  EXPECT_EQ(votes.average_label(2), 2);
  EXPECT_EQ(votes.bayesian_label(1), 1);
  EXPECT_EQ(votes.bayesian_label(0), 1);  // not among the best
  EXPECT_EQ(votes.average_label(kVoid), 1);
  votes.add(std::int16_t{1});
  EXPECT_EQ(votes.bayesian_label(2), 1);
}

TEST(ClassVotes, NothingAddedIsVoid) {
  ClassVotes votes = three();
  votes.add(std::int16_t{2});
  votes.clear();
  EXPECT_EQ(votes.bayesian_label(0), kVoid);
  EXPECT_EQ(votes.average_label(0), kVoid);
  Row p{1, 1, 1};
  votes.bayesian(p);
  EXPECT_EQ(p, Row{});
  votes.average(p);
  EXPECT_EQ(p, Row{});
}

TEST(ClassVotes, AConfidenceThatSaysNothingIsRefused) {
  EXPECT_EQ(error_of([] { HardLikelihood(0.25, 4); }),
            "fuse.hard_confidence: 0.25 says nothing among 4 classes, each has 0.25; write more than 0.25");
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

TEST(LabelDiffusion, AChainByHand) {
  // Votes of weight 1 at both ends of 0 - 1 - 2: four equal resistors in a row, read at their three joints.
  const std::vector<GraphEdge> chain{{0, 1, 1}, {1, 2, 1}};
  const std::vector<double> votes{1, 0, 0, 0, 0, 1};
  const Diffusion even = diffuse_votes(chain, votes, 2, 1, {});
  const float expected[] = {0.75F, 0.25F, 0.5F, 0.5F, 0.25F, 0.75F};
  for (std::size_t i = 0; i < 6; ++i) EXPECT_NEAR(even.probability[i], expected[i], 1e-5F) << i;
  EXPECT_EQ(even.parts, 1);
  // Votes that hold harder are nearer to seeds: 1/w + 1 + 1 + 1/w with w = 10.
  EXPECT_NEAR(diffuse_votes(chain, votes, 2, 10, {}).probability[0], 2.1F / 2.2F, 1e-5F);
  // A weak edge between 0 and 1 gives 1 to the other end: from 1, 1/0.1 to the left against 1 to the right.
  const std::vector<GraphEdge> weak{{0, 1, 0.1}, {1, 2, 1}};
  EXPECT_NEAR(diffuse_votes(weak, votes, 2, 1, {}).probability[2], 2.0F / 13.0F, 1e-5F);
}

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

TEST(LabelDiffusion, ThreadsDoNotChangeABit) {
  const Graph graph;
  set_thread_count(1);
  const Diffusion one = graph.spread(1);
  set_thread_count(3);
  const Diffusion three = graph.spread(1);
  set_thread_count(0);
  EXPECT_EQ(one.probability, three.probability);
}

// Real predictions of two networks on frames of Replica, fused with the true depth, where the data are at hand.

const std::string kRoot = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/replica_apartment0";

LoadedScene apartment(const std::string& label_dir, int train_step) {
  ReplicaParams p{.root = kRoot, .label_dir = label_dir, .train_step = train_step, .test_step = 0};
  Replica replica(p, {});
  Diagnostics diagnostics;
  return load_scene(replica, {}, diagnostics);
}

// Total accuracy and mean IoU over the classes present, of the monocular predictions and of their fusion.
struct Figures {
  double monocular = 0, bayesian = 0, average = 0;
  double miou_monocular = 0, miou_bayesian = 0;
};

Figures fuse_predictions(const std::string& network, int train_step) {
  const LoadedScene scene = apartment("semantic_class", train_step);
  const LoadedScene predicted = apartment(network, train_step);
  TrainingLabels labels;
  for (const StoredFrame& frame : predicted.frames) labels.frames.push_back({frame.label, {}});
  const SceneFusion fusion = fuse_scene(scene, labels, true_depth(scene), {}, nullptr);
  EXPECT_EQ(fusion.scores.size(), 3u);
  const auto accuracy = [&](std::size_t k) { return *fusion.scores[k].confusion.total_accuracy(); };
  const auto miou = [&](std::size_t k) { return *fusion.scores[k].confusion.miou_present(); };
  return {accuracy(0), accuracy(1), accuracy(2), miou(0), miou(1)};
}

TEST(RealPredictions, MonocularIsAsItsMakersMeasured) {
  if (!std::filesystem::exists(kRoot)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  for (const auto& [network, accuracy] : {std::pair{"cnn_strong", 0.859}, std::pair{"cnn_weak", 0.428}}) {
    const LoadedScene scene = apartment("semantic_class", 1), predicted = apartment(network, 1);
    ConfusionMatrix all(scene.info.classes.valid_count());
    for (std::size_t f = 0; f < scene.frames.size(); ++f)
      all.add(scene.frames[f].label.expand(), predicted.frames[f].label.expand());
    EXPECT_NEAR(*all.total_accuracy(), accuracy, 0.001) << network;
  }
}

TEST(RealPredictions, FusionImprovesAStrongNetwork) {
  if (!std::filesystem::exists(kRoot)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  const Figures f = fuse_predictions("cnn_strong", 2);
  EXPECT_NEAR(f.monocular, 0.8596, 0.0005);
  EXPECT_GT(f.bayesian, f.monocular + 0.01);
  EXPECT_GT(f.miou_bayesian, f.miou_monocular);
  EXPECT_EQ(f.bayesian, f.average);  // labels without probabilities: both count votes
}

TEST(RealPredictions, MistakesThatAllViewsShareStay) {
  if (!std::filesystem::exists(kRoot)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  const Figures f = fuse_predictions("cnn_weak", 2);
  EXPECT_NEAR(f.monocular, 0.426, 0.001);
  EXPECT_NEAR(f.bayesian, f.monocular, 0.005);
}

}  // namespace
}  // namespace semfield
