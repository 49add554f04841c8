o=h3c.dOut
while true do
    o(17, 1) -- coloca a saída 17 em nível alto
    o(17, 0) -- coloca a saída 17 em nível baixo
end
