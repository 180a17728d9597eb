// The program itself: `mesh` in the forms of other programs, and `eval` by a published protocol.
#include <filesystem>
#include <nlohmann/json.hpp>

#include "tests/mesh/verbs_fixture.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_verbs;

TEST_F(Verbs, MeshWritesFilesForOtherPrograms) {
  const std::string stem = *dir_ / "other/room";
  const Result r = run(*dir_, {"mesh", run_dir(), "--resolution", "32", "--format",
                               "las,pcd,splat,splats.ply,npz,bt,ot,pgm", "--band", "0.1,0.8", "--out", stem, "--json"});
  ASSERT_EQ(r.code, 0) << r.err;
  const nlohmann::json said = nlohmann::json::parse(r.out);
  EXPECT_FALSE(said.contains("faces")) << "no surface is made for points";
  EXPECT_GT(said["points"], 100);
  std::vector<std::string> files;
  for (const char* ending : {".las", ".pcd", ".splats.ply", ".splat", ".npz", ".bt", ".ot", ".pgm", ".yaml"})
    files.push_back(stem + ending);
  EXPECT_EQ(said["files"], files);
  EXPECT_HAS(r.err, "the floor is at ", " along +z");
  const nlohmann::json sidecar = nlohmann::json::parse(read_text_file(stem + ".json"));
  EXPECT_EQ(sidecar["format"], "semfield-handover-1");
  EXPECT_EQ(sidecar["files"].size(), files.size());
  EXPECT_EQ(sidecar["world"]["unit"], "m");
  EXPECT_EQ(sidecar["world"]["up"], (nlohmann::json{0.0, 0.0, 1.0}));
  EXPECT_FALSE(sidecar["classes"].empty());
  const std::string head = read_file_start(stem + ".splats.ply", 200);
  const std::size_t count = std::stoul(head.substr(head.find("vertex ") + 7));
  EXPECT_GT(count, 500U);
  EXPECT_EQ(fs::file_size(stem + ".splat"), 32 * count);
  // The ending alone says so, and a page alone has no sidecar.
  const Result one = run(*dir_, {"mesh", run_dir(), "--resolution", "24", "--out", *dir_ / "one.splats.ply"});
  ASSERT_EQ(one.code, 0) << one.err;
  EXPECT_EQ(one.out, "mesh: file=" + *dir_ / "one.splats.ply" + "\n");
  const Result page = run(*dir_, {"mesh", run_dir(), "--resolution", "24", "--out", *dir_ / "alone.html"});
  ASSERT_EQ(page.code, 0) << page.err;
  EXPECT_FALSE(fs::exists(*dir_ / "alone.json"));
}

TEST_F(Verbs, EvalScoresByAProtocol) {
  const Result r = run(*dir_, {"eval", run_dir(), "--protocol", "semantic_nerf", "--json"});
  ASSERT_EQ(r.code, 0) << r.err;
  const nlohmann::json said = nlohmann::json::parse(r.out), of = said["protocol"];
  EXPECT_EQ(of["miou"], said["miou_present"]);
  EXPECT_EQ(of["total_accuracy"], said["total_accuracy"]);
  EXPECT_EQ(of["frames"].size(), said["frames"]);
  EXPECT_EQ(of["truth"].get<std::string>().size(), 8U);
  const Result shown = run(*dir_, {"eval", run_dir(), "--protocol", "panoptic_lifting"});
  EXPECT_HAS(shown.out, "protocol: name=panoptic_lifting miou=", " truth=" + of["truth"].get<std::string>());
  const Result train = run(*dir_, {"eval", run_dir(), "--protocol", "semantic_nerf", "--split", "train"});
  EXPECT_EQ(train.code, 2);
  EXPECT_HAS(train.err, "[eval.protocol.split]");
}

}  // namespace
}  // namespace semfield
