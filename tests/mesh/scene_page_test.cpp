// The page of a surface as text: what stands in it, whatever the names in the scene are.
#include "app/render/scene_page.h"

#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "tests/says.h"

namespace semfield::app {
namespace {

std::string element(const std::string& page, const std::string& open) {
  const std::size_t begin = page.find(open);
  if (begin == std::string::npos) return {};
  const std::size_t from = begin + open.size();
  return page.substr(from, page.find("</", from) - from);
}

// Names are those of the places that the page's parts are filled into.
TEST(ScenePage, NamesOfAnySceneStayNames) {
  const std::vector<std::string> names{"/*mesh*/", "/*facts*/", "/*script*/", "<!--title-->", "</script>", "/*style*/"};
  std::vector<ClassEntry> entries;
  for (const std::string& name : names)
    entries.push_back({static_cast<std::int32_t>(entries.size()) + 1, name, {}, false});
  Surface surface;
  surface.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  surface.triangles = {{0, 1, 2}};
  surface.attributes.color.assign(3, {1, 2, 3});
  surface.attributes.label.assign(3, 0);
  surface.attributes.entropy.assign(3, 0);
  ScenePage page;
  page.title = "/*mesh*/ <!--connect-->";
  page.about = {"/*mesh*/"};
  page.run = "/*style*/";
  const std::string text = scene_page_text(surface, ClassTable(entries), page);
  const nlohmann::json facts =
      nlohmann::json::parse(element(text, "<script type=\"application/json\" id=\"facts\">"), nullptr, false);
  ASSERT_TRUE(facts.is_object());
  ASSERT_EQ(facts.at("classes").size(), names.size());
  for (std::size_t i = 0; i < names.size(); ++i) EXPECT_EQ(facts.at("classes")[i].at("name"), names[i]);
  EXPECT_EQ(facts.at("title"), page.title);
  EXPECT_EQ(facts.at("run"), page.run);
  const std::string mesh = element(text, "<script type=\"text/plain\" id=\"mesh\">");
  EXPECT_FALSE(mesh.empty());
  EXPECT_EQ(mesh.find('*'), std::string::npos) << "the mesh is where it belongs";
  EXPECT_EQ(element(text, "<title>"), "/*mesh*/ &lt;!--connect--&gt;");
  EXPECT_HAS(text, "connect-src 'none'");
}

}  // namespace
}  // namespace semfield::app
