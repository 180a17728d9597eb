// Votes on a graph: a chain by hand, a direct factorisation as the oracle, parts that no vote reaches, threads.
#include "surface/label_diffusion.h"

#include <gtest/gtest.h>

#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <cmath>

#include "compute/parallel.h"
#include "core/rng.h"

namespace semfield {
namespace {

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
        right(n, c) = weight * graph.votes[static_cast<std::size_t>(n * graph.classes + c)];
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
        const float p = out.probability[static_cast<std::size_t>(n * graph.classes + c)];
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

}  // namespace
}  // namespace semfield
