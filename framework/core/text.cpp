// Words and numbers.
#include "core/text.h"

#include <algorithm>
#include <iterator>

#include "core/error.h"

namespace semfield {

namespace {

// Restricted Damerau-Levenshtein distance: one swap of neighbours counts as one slip, as typists make them.
std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::vector<std::size_t>> d(a.size() + 1, std::vector<std::size_t>(b.size() + 1));
  for (std::size_t i = 0; i <= a.size(); ++i) d[i][0] = i;
  for (std::size_t j = 0; j <= b.size(); ++j) d[0][j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t swap_cost = a[i - 1] == b[j - 1] ? 0 : 1;
      d[i][j] = std::min({d[i - 1][j] + 1, d[i][j - 1] + 1, d[i - 1][j - 1] + swap_cost});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1])
        d[i][j] = std::min(d[i][j], d[i - 2][j - 2] + 1);
    }
  }
  return d[a.size()][b.size()];
}

// The known name of the least distance, at most a third of the word's length.
template <class Distance>
std::string nearest(std::string_view word, const std::vector<std::string>& known, Distance&& distance_to) {
  std::string best;
  if (word.size() > 200) return best;  // no slip of the keyboard
  std::size_t best_distance = std::max<std::size_t>(1, word.size() / 3) + 1;
  for (const std::string& candidate : known) {
    const std::size_t distance = distance_to(candidate);
    if (distance < best_distance) {
      best_distance = distance;
      best = candidate;
    }
  }
  return best;
}

// Canonical decompositions: a table, and Hangul by its rule.

// Letters under one mark, and what they are composed to [Unicode, UnicodeData.txt, field 5]: Latin, Greek of today,
// Cyrillic, kana. Letters may be composed themselves. Escaped: what other tools may rewrite.
struct Mark {
  char16_t mark;
  std::u16string_view letters, composed;
};
constexpr Mark kMarks[] = {
    {0x300, u"AEIOUaeiouÜüNnЕИеиĒēŌōWwÂâĂăÊêÔôƠơƯưYy", u"ÀÈÌÒÙàèìòùǛǜǸǹЀЍѐѝḔḕṐṑẀẁẦầẰằỀềỒồỜờỪừỲỳ"},
    {0x301, u"AEIOUYaeiouyCcLlNnRrSsZzÜüGgÅåÆæØø\u0308¨ΑΕΗΙΟΥΩϊαεηιϋουωϒГКгкÇçĒēÏïKkMmÕõŌōPpŨũWwÂâĂăÊêÔôƠơƯư",
     u"ÁÉÍÓÚÝáéíóúýĆćĹĺŃńŔŕŚśŹźǗǘǴǵǺǻǼǽǾǿ\u0344΅ΆΈΉΊΌΎΏΐάέήίΰόύώϓЃЌѓќḈḉḖḗḮḯḰḱḾḿṌṍṒṓṔṕṸṹẂẃẤấẮắẾếỐốỚớỨứ"},
    {0x302, u"AEIOUaeiouCcGgHhJjSsWwYyZzẠạẸẹỌọ", u"ÂÊÎÔÛâêîôûĈĉĜĝĤĥĴĵŜŝŴŵŶŷẐẑẬậỆệỘộ"},
    {0x303, u"ANOanoIiUuVvÂâĂăEeÊêÔôƠơƯưYy", u"ÃÑÕãñõĨĩŨũṼṽẪẫẴẵẼẽỄễỖỗỠỡỮữỸỹ"},
    {0x304, u"AaEeIiOoUuÜüÄäȦȧÆæǪǫÖöÕõȮȯYyИиУуGgḶḷṚṛ", u"ĀāĒēĪīŌōŪūǕǖǞǟǠǡǢǣǬǭȪȫȬȭȰȱȲȳӢӣӮӯḠḡḸḹṜṝ"},
    {0x306, u"AaEeGgIiOoUuУИиуЖжАаЕеȨȩẠạ", u"ĂăĔĕĞğĬĭŎŏŬŭЎЙйўӁӂӐӑӖӗḜḝẶặ"},
    {0x307, u"CcEeGgIZzAaOoBbDdFfHhMmNnPpRrSsŚśŠšṢṣTtWwXxYyſ", u"ĊċĖėĠġİŻżȦȧȮȯḂḃḊḋḞḟḢḣṀṁṄṅṖṗṘṙṠṡṤṥṦṧṨṩṪṫẆẇẊẋẎẏẛ"},
    {0x308, u"AEIOUaeiouyYΙΥιυϒЕІеіАаӘәЖжЗзИиОоӨөЭэУуЧчЫыHhÕõŪūWwXxt",
     u"ÄËÏÖÜäëïöüÿŸΪΫϊϋϔЁЇёїӒӓӚӛӜӝӞӟӤӥӦӧӪӫӬӭӰӱӴӵӸӹḦḧṎṏṺṻẄẅẌẍẗ"},
    {0x309, u"AaÂâĂăEeÊêIiOoÔôƠơUuƯưYy", u"ẢảẨẩẲẳẺẻỂểỈỉỎỏỔổỞởỦủỬửỶỷ"},
    {0x30A, u"AaUuwy", u"ÅåŮůẘẙ"},
    {0x30B, u"OoUuУу", u"ŐőŰűӲӳ"},
    {0x30C, u"CcDdEeLlNnRrSsTtZzAaIiOoUuÜüGgKkƷʒjHh", u"ČčĎďĚěĽľŇňŘřŠšŤťŽžǍǎǏǐǑǒǓǔǙǚǦǧǨǩǮǯǰȞȟ"},
    {0x30F, u"AaEeIiOoRrUuѴѵ", u"ȀȁȄȅȈȉȌȍȐȑȔȕѶѷ"},
    {0x311, u"AaEeIiOoRrUu", u"ȂȃȆȇȊȋȎȏȒȓȖȗ"},
    {0x31B, u"OoUu", u"ƠơƯư"},
    {0x323, u"BbDdHhKkLlMmNnRrSsTtVvWwZzAaEeIiOoƠơUuƯưYy", u"ḄḅḌḍḤḥḲḳḶḷṂṃṆṇṚṛṢṣṬṭṾṿẈẉẒẓẠạẸẹỊịỌọỢợỤụỰựỴỵ"},
    {0x324, u"Uu", u"Ṳṳ"},
    {0x325, u"Aa", u"Ḁḁ"},
    {0x326, u"SsTt", u"ȘșȚț"},
    {0x327, u"CcGgKkLlNnRrSsTtEeDdHh", u"ÇçĢģĶķĻļŅņŖŗŞşŢţȨȩḐḑḨḩ"},
    {0x328, u"AaEeIiUuOo", u"ĄąĘęĮįŲųǪǫ"},
    {0x32D, u"DdEeLlNnTtUu", u"ḒḓḘḙḼḽṊṋṰṱṶṷ"},
    {0x32E, u"Hh", u"Ḫḫ"},
    {0x330, u"EeIiUu", u"ḚḛḬḭṴṵ"},
    {0x331, u"BbDdKkLlNnRrTtZzh", u"ḆḇḎḏḴḵḺḻṈṉṞṟṮṯẔẕẖ"},
    {0x3099, u"かきくけこさしすせそたちつてとはひふへほうゝカキクケコサシスセソタチツテトハヒフヘホウワヰヱヲヽ",
     u"がぎぐげござじずぜぞだぢづでどばびぶべぼゔゞガギグゲゴザジズゼゾダヂヅデドバビブベボヴヷヸヹヺヾ"},
    {0x309A, u"はひふへほハヒフヘホ", u"ぱぴぷぺぽパピプペポ"},
};
static_assert(std::all_of(std::begin(kMarks), std::end(kMarks),
                          [](const Mark& m) { return m.letters.size() == m.composed.size(); }));

void append_utf8(std::uint32_t c, std::string& out) {
  if (c < 0x80) {
    out += static_cast<char>(c);
  } else if (c < 0x800) {
    out += static_cast<char>(0xC0 | c >> 6);
    out += static_cast<char>(0x80 | (c & 0x3F));
  } else {
    out += static_cast<char>(0xE0 | c >> 12);
    out += static_cast<char>(0x80 | (c >> 6 & 0x3F));
    out += static_cast<char>(0x80 | (c & 0x3F));
  }
}

void append_parts(std::uint32_t c, std::string& out) {
  constexpr std::uint32_t kHangul = 0xAC00, kSyllables = 11172, kTails = 28, kVowelsAndTails = 588;
  if (c >= kHangul && c < kHangul + kSyllables) {  // [Unicode, section 3.12]
    const std::uint32_t s = c - kHangul;
    append_utf8(0x1100 + s / kVowelsAndTails, out);
    append_utf8(0x1161 + s % kVowelsAndTails / kTails, out);
    if (s % kTails != 0) append_utf8(0x11A7 + s % kTails, out);
    return;
  }
  for (const Mark& m : kMarks) {
    const std::size_t at = m.composed.find(static_cast<char16_t>(c));
    if (at == std::u16string_view::npos) continue;
    append_parts(m.letters[at], out);
    return append_parts(m.mark, out);
  }
  append_utf8(c, out);
}

}  // namespace

std::string lower_case(std::string text) {
  for (char& c : text) c = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
  return text;
}

std::vector<std::string_view> words_of(std::string_view text) {
  constexpr std::string_view kBlank = " \t\r\n\v\f";
  std::vector<std::string_view> out;
  for (std::size_t at = text.find_first_not_of(kBlank); at != std::string_view::npos;) {
    const std::size_t end = std::min(text.find_first_of(kBlank, at), text.size());
    out.push_back(text.substr(at, end - at));
    at = text.find_first_not_of(kBlank, end);
  }
  return out;
}

std::vector<std::string> word_list(std::string_view text) {
  const std::vector<std::string_view> words = words_of(text);
  return {words.begin(), words.end()};
}

std::vector<std::string_view> parts_of(std::string_view text, char separator) {
  std::vector<std::string_view> out;
  for (std::size_t at = 0; at <= text.size(); at += out.back().size() + 1)
    out.push_back(text.substr(at, text.find(separator, at) - at));
  return out;
}

bool next_line(std::string_view& text, std::string_view& line) {
  if (text.empty()) return false;
  const std::size_t end = text.find('\n');
  line = text.substr(0, end);
  text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
  if (!line.empty() && line.back() == '\r') line.remove_suffix(1);
  return true;
}

bool parse_number(std::string_view word, double& out) {
  if (word.size() > 1 && word[0] == '+' && word[1] != '-') word.remove_prefix(1);
  const std::optional<double> value = to_number<double>(word);
  if (value) out = *value;
  return value.has_value();
}

std::string_view parse_numbers(std::string_view text, std::vector<double>& out) {
  for (const std::string_view word : words_of(text)) {
    if (double value = 0; parse_number(word, value))
      out.push_back(value);
    else
      return text.substr(static_cast<std::size_t>(word.data() - text.data()));
  }
  return {};
}

std::size_t utf8_length(std::string_view text, std::size_t i) {
  const auto at_byte = [&](std::size_t k) {
    return k < text.size() ? static_cast<unsigned char>(text[k]) : static_cast<unsigned char>(0);
  };
  const auto continues = [&](std::size_t k) { return k < text.size() && continues_utf8(text[k]); };
  const unsigned a = at_byte(i), b = at_byte(i + 1);
  if (a < 0x80) return 1;
  if (a >= 0xC2 && a <= 0xDF) return continues(i + 1) ? 2 : 0;
  if (a >= 0xE0 && a <= 0xEF) {
    const bool overlong = a == 0xE0 && b < 0xA0, surrogate = a == 0xED && b >= 0xA0;
    return continues(i + 1) && continues(i + 2) && !overlong && !surrogate ? 3 : 0;
  }
  if (a >= 0xF0 && a <= 0xF4) {
    const bool overlong = a == 0xF0 && b < 0x90, beyond = a == 0xF4 && b >= 0x90;
    return continues(i + 1) && continues(i + 2) && continues(i + 3) && !overlong && !beyond ? 4 : 0;
  }
  return 0;
}

std::uint32_t character_at(std::string_view text, std::size_t length) {
  const auto byte = [&](std::size_t i) { return static_cast<std::uint32_t>(static_cast<unsigned char>(text[i])); };
  std::uint32_t out = length == 1 ? byte(0) : byte(0) & (0xFFu >> (length + 1));
  for (std::size_t i = 1; i < length; ++i) out = out << 6 | (byte(i) & 0x3Fu);
  return out;
}

bool is_line_of_text(std::string_view text) {
  for (std::size_t i = 0; i < text.size();) {
    const auto byte = static_cast<unsigned char>(text[i]);
    const std::size_t length = utf8_length(text, i);
    if (byte < 0x20 || byte == 0x7F || length == 0) return false;
    i += length;
  }
  return true;
}

std::string shell_word(std::string_view text) {
  const auto plain = [](char c) {
    return is_alnum(c) || std::string_view("_@%+=:,./-").find(c) != std::string_view::npos;
  };
  if (!text.empty() && std::all_of(text.begin(), text.end(), plain)) return std::string(text);
  std::string word = "'";
  for (const char c : text) word += c == '\'' ? std::string("'\\''") : std::string(1, c);
  return word + "'";
}

std::string json_cause(const std::string& message) {
  const std::size_t end = message.find("] ");
  return !message.empty() && message[0] == '[' && end != std::string::npos ? message.substr(end + 2) : message;
}

std::string closest_spelling(std::string_view word, const std::vector<std::string>& known) {
  return nearest(word, known, [&](const std::string& candidate) { return edit_distance(word, candidate); });
}

std::string did_you_mean(std::string_view word, const std::vector<std::string>& known) {
  return nearest(word, known, [&](const std::string& candidate) {
    // A part of four letters in common also counts as near ('n_level' is far from 'levels' by edits alone).
    const std::size_t distance = edit_distance(word, candidate);
    const bool shared =
        word.size() >= 4 && candidate.find(word.substr(word.size() > 4 ? word.size() - 5 : 0)) != std::string::npos;
    return shared ? std::min<std::size_t>(distance, 2) : distance;
  });
}

std::string near_name_remedy(std::string_view word, const std::vector<std::string>& known, std::string otherwise) {
  const std::string near = did_you_mean(word, known);
  return near.empty() ? otherwise : "did you mean '" + near + "'?";
}

std::string decomposed(std::string_view text) {
  std::string out;
  for (std::size_t i = 0; i < text.size();) {
    const std::size_t length = utf8_length(text, i);
    if (length == 2 || length == 3) {
      append_parts(character_at(text.substr(i), length), out);
    } else {
      out.append(text, i, std::max<std::size_t>(length, 1));
    }
    i += std::max<std::size_t>(length, 1);
  }
  return out;
}

}  // namespace semfield
