// Words and numbers.
#include "core/text.h"

#include <algorithm>
#include <charconv>
#include <cstdint>
#include <iterator>
#include <system_error>

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

// Letters under one mark, and what they are composed to [Unicode, UnicodeData.txt, field 5]; 0: another character
// alone. Letters may be composed themselves. Escaped: what other tools may rewrite, and what runs from right to left.
struct Mark {
  char16_t mark;
  std::u16string_view letters, composed;
};
constexpr Mark kMarks[] = {
    {0x0, u"\u0300\u0301\u0313ʹ;\u00B7άέήίόύώΆιΈΉΐΊΰΎ΅`ΌΏ´\u2002\u2003ΩKÅ\u3008\u3009",
     u"\u0340\u0341\u0343\u0374\u037E\u0387\u1F71\u1F73\u1F75\u1F77\u1F79\u1F7B\u1F7D\u1FBB\u1FBE\u1FC9\u1FCB"
     u"\u1FD3\u1FDB\u1FE3\u1FEB\u1FEE\u1FEF\u1FF9\u1FFB\u1FFD\u2000\u2001\u2126\u212A\u212B\u2329\u232A"},
    {0x300, u"AEIOUaeiouÜüNnЕИеиĒēŌōWwÂâĂăÊêÔôƠơƯưYyἀἁἈἉἐἑἘἙἠἡἨἩἰἱἸἹὀὁὈὉὐὑὙὠὡὨὩαεηιουωΑΕΗ᾿ϊΙ῾ϋΥ¨ΟΩ",
     u"ÀÈÌÒÙàèìòùǛǜǸǹЀЍѐѝḔḕṐṑẀẁẦầẰằỀềỒồỜờỪừỲỳἂἃἊἋἒἓἚἛἢἣἪἫἲἳἺἻὂὃὊὋὒὓὛὢὣὪὫὰὲὴὶὸὺὼᾺῈῊ῍ῒῚ῝ῢῪ῭ῸῺ"},
    {0x301,
     u"AEIOUYaeiouyCcLlNnRrSsZzÜüGgÅåÆæØø\u0308¨ΑΕΗΙΟΥΩϊαεηιϋουωϒГКгкÇçĒēÏïKkMmÕõŌōPpŨũWwÂâĂăÊêÔôƠơƯưἀἁἈἉἐἑἘἙἠἡ"
     u"ἨἩἰἱἸἹὀὁὈὉὐὑὙὠὡὨὩ᾿῾",
     u"ÁÉÍÓÚÝáéíóúýĆćĹĺŃńŔŕŚśŹźǗǘǴǵǺǻǼǽǾǿ\u0344΅ΆΈΉΊΌΎΏΐάέήίΰόύώϓЃЌѓќḈḉḖḗḮḯḰḱḾḿṌṍṒṓṔṕṸṹẂẃẤấẮắẾếỐốỚớỨứἄἅἌἍἔἕἜἝἤἥ"
     u"ἬἭἴἵἼἽὄὅὌὍὔὕὝὤὥὬὭ῎῞"},
    {0x302, u"AEIOUaeiouCcGgHhJjSsWwYyZzẠạẸẹỌọ", u"ÂÊÎÔÛâêîôûĈĉĜĝĤĥĴĵŜŝŴŵŶŷẐẑẬậỆệỘộ"},
    {0x303, u"ANOanoIiUuVvÂâĂăEeÊêÔôƠơƯưYy", u"ÃÑÕãñõĨĩŨũṼṽẪẫẴẵẼẽỄễỖỗỠỡỮữỸỹ"},
    {0x304, u"AaEeIiOoUuÜüÄäȦȧÆæǪǫÖöÕõȮȯYyИиУуGgḶḷṚṛαΑιΙυΥ", u"ĀāĒēĪīŌōŪūǕǖǞǟǠǡǢǣǬǭȪȫȬȭȰȱȲȳӢӣӮӯḠḡḸḹṜṝᾱᾹῑῙῡῩ"},
    {0x306, u"AaEeGgIiOoUuУИиуЖжАаЕеȨȩẠạαΑιΙυΥ", u"ĂăĔĕĞğĬĭŎŏŬŭЎЙйўӁӂӐӑӖӗḜḝẶặᾰᾸῐῘῠῨ"},
    {0x307, u"CcEeGgIZzAaOoBbDdFfHhMmNnPpRrSsŚśŠšṢṣTtWwXxYyſ", u"ĊċĖėĠġİŻżȦȧȮȯḂḃḊḋḞḟḢḣṀṁṄṅṖṗṘṙṠṡṤṥṦṧṨṩṪṫẆẇẊẋẎẏẛ"},
    {0x308, u"AEIOUaeiouyYΙΥιυϒЕІеіАаӘәЖжЗзИиОоӨөЭэУуЧчЫыHhÕõŪūWwXxt",
     u"ÄËÏÖÜäëïöüÿŸΪΫϊϋϔЁЇёїӒӓӚӛӜӝӞӟӤӥӦӧӪӫӬӭӰӱӴӵӸӹḦḧṎṏṺṻẄẅẌẍẗ"},
    {0x309, u"AaÂâĂăEeÊêIiOoÔôƠơUuƯưYy", u"ẢảẨẩẲẳẺẻỂểỈỉỎỏỔổỞởỦủỬửỶỷ"},
    {0x30A, u"AaUuwy", u"ÅåŮůẘẙ"},
    {0x30B, u"OoUuУу", u"ŐőŰűӲӳ"},
    {0x30C, u"CcDdEeLlNnRrSsTtZzAaIiOoUuÜüGgKkƷʒjHh", u"ČčĎďĚěĽľŇňŘřŠšŤťŽžǍǎǏǐǑǒǓǔǙǚǦǧǨǩǮǯǰȞȟ"},
    {0x30F, u"AaEeIiOoRrUuѴѵ", u"ȀȁȄȅȈȉȌȍȐȑȔȕѶѷ"},
    {0x311, u"AaEeIiOoRrUu", u"ȂȃȆȇȊȋȎȏȒȓȖȗ"},
    {0x313, u"αΑεΕηΗιΙοΟυωΩρ", u"ἀἈἐἘἠἨἰἸὀὈὐὠὨῤ"},
    {0x314, u"αΑεΕηΗιΙοΟυΥωΩρΡ", u"ἁἉἑἙἡἩἱἹὁὉὑὙὡὩῥῬ"},
    {0x31B, u"OoUu", u"ƠơƯư"},
    {0x323, u"BbDdHhKkLlMmNnRrSsTtVvWwZzAaEeIiOoƠơUuƯưYy", u"ḄḅḌḍḤḥḲḳḶḷṂṃṆṇṚṛṢṣṬṭṾṿẈẉẒẓẠạẸẹỊịỌọỢợỤụỰựỴỵ"},
    {0x326, u"SsTt", u"ȘșȚț"},
    {0x327, u"CcGgKkLlNnRrSsTtEeDdHh", u"ÇçĢģĶķĻļŅņŖŗŞşŢţȨȩḐḑḨḩ"},
    {0x328, u"AaEeIiUuOo", u"ĄąĘęĮįŲųǪǫ"},
    {0x32D, u"DdEeLlNnTtUu", u"ḒḓḘḙḼḽṊṋṰṱṶṷ"},
    {0x330, u"EeIiUu", u"ḚḛḬḭṴṵ"},
    {0x331, u"BbDdKkLlNnRrTtZzh", u"ḆḇḎḏḴḵḺḻṈṉṞṟṮṯẔẕẖ"},
    {0x338, u"←→↔\u21D0⇔⇒∃∈∋∣∥∼≃≅≈=≡≍<>≤≥≲≳≶≷≺≻⊂⊃⊆⊇⊢⊨⊩⊫≼≽⊑⊒⊲⊳⊴⊵⫝",
     u"↚↛↮\u21CD⇎⇏∄∉∌∤∦≁≄≇≉≠≢≭≮≯≰≱≴≵≸≹⊀⊁⊄⊅⊈⊉⊬⊭⊮⊯⋠⋡⋢⋣⋪⋫⋬⋭\u2ADC"},
    {0x342, u"ἀἁἈἉἠἡἨἩἰἱἸἹὐὑὙὠὡὨὩα¨η᾿ιϊ῾υϋω", u"ἆἇἎἏἦἧἮἯἶἷἾἿὖὗὟὦὧὮὯᾶ῁ῆ῏ῖῗ῟ῦῧῶ"},
    {0x345, u"ἀἁἂἃἄἅἆἇἈἉἊἋἌἍἎἏἠἡἢἣἤἥἦἧἨἩἪἫἬἭἮἯὠὡὢὣὤὥὦὧὨὩὪὫὬὭὮὯὰαάᾶΑὴηήῆΗὼωώῶΩ",
     u"ᾀᾁᾂᾃᾄᾅᾆᾇᾈᾉᾊᾋᾌᾍᾎᾏᾐᾑᾒᾓᾔᾕᾖᾗᾘᾙᾚᾛᾜᾝᾞᾟᾠᾡᾢᾣᾤᾥᾦᾧᾨᾩᾪᾫᾬᾭᾮᾯᾲᾳᾴᾷᾼῂῃῄῇῌῲῳῴῷῼ"},
    {0x5BC,
     u"\u05D0\u05D1\u05D2\u05D3\u05D4\u05D5\u05D6\u05D8\u05D9\u05DA\u05DB\u05DC\u05DE\u05E0\u05E1\u05E3\u05E4"
     u"\u05E6\u05E7\u05E8\u05E9\u05EA",
     u"\uFB30\uFB31\uFB32\uFB33\uFB34\uFB35\uFB36\uFB38\uFB39\uFB3A\uFB3B\uFB3C\uFB3E\uFB40\uFB41\uFB43\uFB44"
     u"\uFB46\uFB47\uFB48\uFB49\uFB4A"},
    {0x654, u"\u0627\u0648\u064A\u06D5\u06C1\u06D2", u"\u0623\u0624\u0626\u06C0\u06C2\u06D3"},
    {0x93C, u"नरळकखगजडढफय", u"ऩऱऴ\u0958\u0959\u095A\u095B\u095C\u095D\u095E\u095F"},
    {0xA3C, u"ਲਸਖਗਜਫ", u"\u0A33\u0A36\u0A59\u0A5A\u0A5B\u0A5E"},
    {0xFB7, u"གཌདབཛ\u0F92\u0F9C\u0FA1\u0FA6\u0FAB", u"\u0F43\u0F4D\u0F52\u0F57\u0F5C\u0F93\u0F9D\u0FA2\u0FA7\u0FAC"},
    {0x1B35, u"ᬅᬇᬉᬋᬍᬑ\u1B3A\u1B3C\u1B3E\u1B3F\u1B42", u"ᬆᬈᬊᬌᬎᬒ\u1B3B\u1B3D\u1B40\u1B41\u1B43"},
    {0x3099, u"かきくけこさしすせそたちつてとはひふへほうゝカキクケコサシスセソタチツテトハヒフヘホウワヰヱヲヽ",
     u"がぎぐげござじずぜぞだぢづでどばびぶべぼゔゞガギグゲゴザジズゼゾダヂヅデドバビブベボヴヷヸヹヺヾ"},
    {0x309A, u"はひふへほハヒフヘホ", u"ぱぴぷぺぽパピプペポ"},
};
struct Parts {
  char16_t composed, letter, mark;
};
constexpr Parts kRareMarks[] = {
    {0x622, 0x627, 0x653},    {0x625, 0x627, 0x655},  {0x9CB, 0x9C7, 0x9BE},  {0x9CC, 0x9C7, 0x9D7},
    {0x9DC, 0x9A1, 0x9BC},    {0x9DD, 0x9A2, 0x9BC},  {0x9DF, 0x9AF, 0x9BC},  {0xB48, 0xB47, 0xB56},
    {0xB4B, 0xB47, 0xB3E},    {0xB4C, 0xB47, 0xB57},  {0xB5C, 0xB21, 0xB3C},  {0xB5D, 0xB22, 0xB3C},
    {0xB94, 0xB92, 0xBD7},    {0xBCA, 0xBC6, 0xBBE},  {0xBCB, 0xBC7, 0xBBE},  {0xBCC, 0xBC6, 0xBD7},
    {0xC48, 0xC46, 0xC56},    {0xCC0, 0xCBF, 0xCD5},  {0xCC7, 0xCC6, 0xCD5},  {0xCC8, 0xCC6, 0xCD6},
    {0xCCA, 0xCC6, 0xCC2},    {0xCCB, 0xCCA, 0xCD5},  {0xD4A, 0xD46, 0xD3E},  {0xD4B, 0xD47, 0xD3E},
    {0xD4C, 0xD46, 0xD57},    {0xDDA, 0xDD9, 0xDCA},  {0xDDC, 0xDD9, 0xDCF},  {0xDDD, 0xDDC, 0xDCA},
    {0xDDE, 0xDD9, 0xDDF},    {0xF69, 0xF40, 0xFB5},  {0xF73, 0xF71, 0xF72},  {0xF75, 0xF71, 0xF74},
    {0xF76, 0xFB2, 0xF80},    {0xF78, 0xFB3, 0xF80},  {0xF81, 0xF71, 0xF80},  {0xFB9, 0xF90, 0xFB5},
    {0x1026, 0x1025, 0x102E}, {0x1E00, 0x41, 0x325},  {0x1E01, 0x61, 0x325},  {0x1E2A, 0x48, 0x32E},
    {0x1E2B, 0x68, 0x32E},    {0x1E72, 0x55, 0x324},  {0x1E73, 0x75, 0x324},  {0xFB1D, 0x5D9, 0x5B4},
    {0xFB1F, 0x5F2, 0x5B7},   {0xFB2A, 0x5E9, 0x5C1}, {0xFB2B, 0x5E9, 0x5C2}, {0xFB2C, 0xFB49, 0x5C1},
    {0xFB2D, 0xFB49, 0x5C2},  {0xFB2E, 0x5D0, 0x5B7}, {0xFB2F, 0x5D0, 0x5B8}, {0xFB4B, 0x5D5, 0x5B9},
    {0xFB4C, 0x5D1, 0x5BF},   {0xFB4D, 0x5DB, 0x5BF}, {0xFB4E, 0x5E4, 0x5BF},
};
static_assert(std::all_of(std::begin(kMarks), std::end(kMarks),
                          [](const Mark& m) { return m.letters.size() == m.composed.size(); }));

Parts parts_of(char16_t c) {
  for (const Mark& m : kMarks) {
    if (const std::size_t at = m.composed.find(c); at != std::u16string_view::npos) return {c, m.letters[at], m.mark};
  }
  for (const Parts& parts : kRareMarks)
    if (parts.composed == c) return parts;
  return {c, 0, 0};
}

std::uint32_t character_at(std::string_view text, std::size_t length) {
  const auto byte = [&](std::size_t i) { return static_cast<std::uint32_t>(static_cast<unsigned char>(text[i])); };
  std::uint32_t out = length == 1 ? byte(0) : byte(0) & (0xFFu >> (length + 1));
  for (std::size_t i = 1; i < length; ++i) out = out << 6 | (byte(i) & 0x3Fu);
  return out;
}

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
  const Parts parts = parts_of(static_cast<char16_t>(c));
  if (parts.letter == 0) return append_utf8(c, out);
  append_parts(parts.letter, out);
  if (parts.mark != 0) append_parts(parts.mark, out);
}

}  // namespace

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
  double value = 0;
  const auto [end, status] = std::from_chars(word.data(), word.data() + word.size(), value);
  if (status != std::errc{} || end != word.data() + word.size()) return false;
  out = value;
  return true;
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
  const auto continues = [&](std::size_t k) { return (at_byte(k) & 0xC0u) == 0x80u; };
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
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') ||
           std::string_view("_@%+=:,./-").find(c) != std::string_view::npos;
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
